// Adam on the rows of a table that a batch touched.
#include "parts.h"
#include "scene.h"
#include "table.h"

#include <cmath>
#include <type_traits>

namespace {

// Numbers in bfloat16 are the upper halves of floats, rounded to nearest even.
float widen(uint16_t half) {
    const uint32_t bits = uint32_t(half) << 16;
    float x;
    __builtin_memcpy(&x, &bits, sizeof x);
    return x;
}

uint16_t narrow(float x) {
    uint32_t bits;
    __builtin_memcpy(&bits, &x, sizeof bits);
    return uint16_t((bits + 0x7fff + ((bits >> 16) & 1)) >> 16);
}

// Adam on distinct rows; the empty brick and entries whose gradient is exactly 0 do not change. `moments`
// [T, 2, channels], means and uncentred variances, are in bfloat16.
void mmpi_adam_rows(int64_t begin, int64_t end, const int64_t* rows, int64_t channels, const float* grad, float* param,
                    uint16_t* moments, float beta1, float beta2, float correction, float eps, float rate) {
    for (int64_t i = begin; i < end; i++) {
        if (i + AHEAD < end) {
            prefetch_row(param + rows[i + AHEAD] * channels, channels);
            prefetch_row(moments + rows[i + AHEAD] * 2 * channels, 2 * channels);
        }
        if (rows[i] < BRICK) continue;
        const float* __restrict g = grad + i * channels;
        float* __restrict value = param + rows[i] * channels;
        uint16_t* __restrict mean = moments + rows[i] * 2 * channels;
        const auto step_row = [&](auto size) {
            for (int64_t c = 0; c < size; c++) {
                const bool touched = g[c] != 0;
                const float m = widen(mean[c]), s = widen(mean[size + c]);
                const float new_mean = m + (1 - beta1) * (g[c] - m), new_square = s * beta2 + (1 - beta2) * g[c] * g[c];
                const float step = rate * (new_mean / (std::sqrt(new_square) / correction + eps));
                mean[c] = touched ? narrow(new_mean) : mean[c];
                mean[size + c] = touched ? narrow(new_square) : mean[size + c];
                value[c] = touched ? value[c] - step : value[c];
            }
        };
        if (channels == OCTET)
            step_row(std::integral_constant<int64_t, OCTET>{});
        else
            step_row(channels);
    }
}

} // namespace

IN_PARTS(mmpi_adam_rows)
