// Rows of tables that a batch touched: which, their gradients, and Adam on them. References in ops/interpolate.py,
// losses.py and touched_adam.py.
#include "scene.h"

namespace {

constexpr int64_t AHEAD = 8; // rows whose cache lines are asked for before they are needed

template <typename T> void prefetch_row(const T* row, int64_t channels) {
    const char* end = reinterpret_cast<const char*>(row + channels);
    for (const char* line = reinterpret_cast<const char*>(row); line < end; line += 64) __builtin_prefetch(line);
}

} // namespace

extern "C" {

// Numbers the distinct values of `rows` in the order of their first occurrence. `slots` holds 2^bits >= 2 count
// entries of -1. Returns how many there are; `unique` and `position` have room for `count`.
int64_t mmpi_index_rows(const int64_t* rows, int64_t count, int32_t* slots, int bits, int64_t* unique,
                        int32_t* position) {
    const uint64_t mask = (uint64_t(1) << bits) - 1;
    int64_t found = 0;
    for (int64_t i = 0; i < count; i++) {
        const int64_t row = rows[i];
        uint64_t slot = (uint64_t(row) * 0x9E3779B97F4A7C15ull) >> (64 - bits);
        while (slots[slot] >= 0 && unique[slots[slot]] != row) slot = (slot + 1) & mask;
        if (slots[slot] < 0) {
            slots[slot] = int32_t(found);
            unique[found++] = row;
        }
        position[i] = slots[slot];
    }
    return found;
}

// values[position[n, b]] += weights[n, b] * grad[n], with weights of 1 where none are given.
void mmpi_scatter_rows(const int32_t* position, const float* weights, const float* grad, int64_t samples, int64_t taps,
                       int64_t channels, float* values) {
    for (int64_t n = 0; n < samples; n++) {
        const float* from = grad + n * channels;
        for (int64_t b = 0; b < taps; b++) {
            float* to = values + int64_t(position[n * taps + b]) * channels;
            const float weight = weights ? weights[n * taps + b] : 1.0f;
            for (int64_t c = 0; c < channels; c++) to[c] += weight * from[c];
        }
    }
}

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

// Huber loss of the differences of texels with their neighbours (losses.total_variation), and its gradient. `scales`
// are those of x, y and z of each head; neighbours are held fixed.
double mmpi_total_variation(const int64_t* rows, int64_t count, int64_t channels, const float* table, const Grid* grids,
                            int64_t num_heads, const float* scales, float* grad) {
    double total = 0;
    int64_t head = 0;
    for (int64_t i = 0; i < count; i++) {
        const auto holds = [&](const Grid& g) {
            return rows[i] >= g.offset && rows[i] < g.offset + g.depth * g.height * g.width;
        };
        while (!holds(grids[head])) head = (head + 1) % num_heads; // rows come head by head, mostly
        const Grid& grid = grids[head];
        const int64_t sizes[3] = {grid.width, grid.height, grid.depth};
        const int64_t strides[3] = {1, grid.width, grid.width * grid.height};
        if (i + AHEAD < count) { // the neighbours that lie in other cache lines; a prefetch may miss the table
            const float* next = table + rows[i + AHEAD] * channels;
            prefetch_row(next, channels);
            for (int axis = 1; axis < 3; axis++) {
                prefetch_row(next - strides[axis] * channels, channels);
                prefetch_row(next + strides[axis] * channels, channels);
            }
        }
        const int64_t local = rows[i] - grid.offset;
        const int64_t at[3] = {local % sizes[0], local / strides[1] % sizes[1], local / strides[2]};
        const float* own = table + rows[i] * channels;
        float* to = grad + i * channels;
        for (int64_t c = 0; c < channels; c++) to[c] = 0;
        for (int axis = 0; axis < 3; axis++)
            for (int side = -1; side <= 1; side += 2) {
                if (at[axis] + side < 0 || at[axis] + side >= sizes[axis]) continue;
                const float *other = own + side * strides[axis] * channels, scale = scales[3 * head + axis] / 6;
                float sum = 0;
                for (int64_t c = 0; c < channels; c++) {
                    const float difference = own[c] - other[c], size = std::abs(difference);
                    to[c] += scale * std::min(std::max(difference, -1.0f), 1.0f);
                    sum += size <= 1 ? 0.5f * difference * difference : size - 0.5f;
                }
                total += scale * sum;
            }
    }
    return total;
}
}
