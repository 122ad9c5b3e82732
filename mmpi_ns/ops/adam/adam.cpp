// Adam on the rows of a table that a batch touched. The reference is reference.py.
#include "table.h"

#include <cmath>

extern "C" {

// Adam on distinct rows; entries whose gradient is exactly 0 are left alone.
void mmpi_adam_rows(const int64_t* rows, int64_t begin, int64_t end, int64_t channels, const float* grad, float* param,
                    float* mean, float* square, float beta1, float beta2, float correction, float eps, float rate) {
    for (int64_t i = begin; i < end; i++) {
        if (i + AHEAD < end) {
            const int64_t next = rows[i + AHEAD] * channels;
            prefetch_row(param + next, channels);
            prefetch_row(mean + next, channels);
            prefetch_row(square + next, channels);
        }
        const float* g = grad + i * channels;
        float *p = param + rows[i] * channels, *m = mean + rows[i] * channels, *s = square + rows[i] * channels;
        for (int64_t c = 0; c < channels; c++) {
            const bool touched = g[c] != 0;
            const float new_mean = m[c] + (1 - beta1) * (g[c] - m[c]);
            const float new_square = s[c] * beta2 + (1 - beta2) * g[c] * g[c];
            const float step = rate * (new_mean / (std::sqrt(new_square) / correction + eps));
            m[c] = touched ? new_mean : m[c];
            s[c] = touched ? new_square : s[c];
            p[c] = touched ? p[c] - step : p[c];
        }
    }
}
}
