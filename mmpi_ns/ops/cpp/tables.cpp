// Rows of tables that a batch touched: which, their gradients, and Adam on them. References in ops/interpolate.py,
// losses.py and touched_adam.py.
#include "scene.h"

namespace {

constexpr int64_t AHEAD = 8; // rows whose cache lines are asked for before they are needed

template <typename T> void prefetch_row(const T* row, int64_t channels) {
    const char* end = reinterpret_cast<const char*>(row + channels);
    for (const char* line = reinterpret_cast<const char*>(row); line < end; line += 64) __builtin_prefetch(line);
}

// Asks for a texel's lines and those of its neighbours above, below, before and behind; a prefetch may miss the table.
void prefetch_around(const Grid& grid, const float* table, int64_t row, int64_t place, int64_t channels) {
    for (int64_t beside = -8; beside <= 8; beside += 8) prefetch_row(table + (row + beside) * channels, channels);
    const int64_t layer = grid.down * grid.across, first = grid.first_tile, end = first + grid.depth * layer;
    for (int64_t tile = place - layer; tile <= place + layer; tile += 2 * layer)
        if (tile >= first && tile < end)
            prefetch_row(table + (grid.tiles[tile] * BRICK + row % BRICK) * channels, channels);
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

// Rows and weights of bilinear lookups at (u, v, .) of `ndc` on planes of one head (TexelGrid.bilinear).
void mmpi_bilinear_rows(const Grid* grid, const int64_t* planes, const float* ndc, int64_t count, int64_t* rows,
                        float* weights) {
    for (int64_t i = 0; i < count; i++) {
        const Cell x(ndc[3 * i], grid->width), y(ndc[3 * i + 1], grid->height);
        const Corners corners(*grid, planes[i], y.lower, x.lower);
        const float fx = x.fraction, fy = y.fraction, gx = 1 - fx, gy = 1 - fy;
        const float weight[4] = {gx * gy, fx * gy, gx * fy, fx * fy};
        for (int k = 0; k < 4; k++) {
            rows[4 * i + k] = corners.row[k];
            weights[4 * i + k] = weight[k];
        }
    }
}

// Huber loss of the differences of texels with their stored neighbours (losses.total_variation), and its gradient.
// `scales` are those of x, y and z of each head; neighbours are held fixed. `places` names the tile of every brick.
double mmpi_total_variation(const int64_t* rows, int64_t count, int64_t channels, const float* table, const Grid* grids,
                            int64_t num_heads, const int64_t* places, const float* scales, float* grad) {
    double total = 0;
    int64_t head = 0;
    for (int64_t i = 0; i < count; i++) {
        float* to = grad + i * channels;
        for (int64_t c = 0; c < channels; c++) to[c] = 0;
        const int64_t place = places[rows[i] / BRICK];
        if (place < 0) continue; // the empty brick
        const auto holds = [&](const Grid& g) {
            return place >= g.first_tile && place < g.first_tile + g.depth * g.down * g.across;
        };
        while (!holds(grids[head])) head = (head + 1) % num_heads; // rows come head by head, mostly
        const Grid& grid = grids[head];
        if (i + AHEAD < count) prefetch_around(grid, table, rows[i + AHEAD], places[rows[i + AHEAD] / BRICK], channels);
        const uint32_t tile = uint32_t(place - grid.first_tile), across = uint32_t(grid.across);
        const uint32_t line = tile / across, down = uint32_t(grid.down);
        const int in_brick[3] = {int(rows[i] & 7), int(rows[i] >> 3 & 7), 0};
        const int64_t at[3] = {int64_t(tile % across) * 8 + in_brick[0], int64_t(line % down) * 8 + in_brick[1],
                               line / down};
        const int64_t sizes[3] = {grid.width, grid.height, grid.depth};
        const int64_t tile_steps[3] = {1, grid.across, grid.across * grid.down}, row_steps[3] = {1, 8, 0};
        const float* own = table + rows[i] * channels;
        for (int axis = 0; axis < 3; axis++)
            for (int side = -1; side <= 1; side += 2) {
                if (at[axis] + side < 0 || at[axis] + side >= sizes[axis]) continue;
                int64_t row = rows[i] + side * row_steps[axis];
                const int edge = side < 0 ? 0 : 7;
                if (axis == 2 || in_brick[axis] == edge) { // in another brick
                    const int32_t brick = grid.tiles[place + side * tile_steps[axis]];
                    if (!brick) continue;
                    row = int64_t(brick) * BRICK + ((rows[i] & 63) - side * 7 * row_steps[axis]);
                }
                const float *other = table + row * channels, scale = scales[3 * head + axis] / 6;
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
