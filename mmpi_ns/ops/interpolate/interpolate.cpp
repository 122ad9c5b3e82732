// Rows of tables that a batch reads: which, what is there, and their gradients. The reference is reference.py.
#include "scene.h"
#include "table.h"

namespace {

// Which rows of a brick occur, and how many others come before them.
struct Seen {
    uint64_t rows;
    int64_t before;
};

} // namespace

extern "C" {

// Numbers the distinct values of `rows`, none negative, in rising order. `bricks` holds as many bricks as the largest
// value needs, all zero. Returns how many there are; `unique` and `position` have room for `count`.
int64_t mmpi_index_rows(const int64_t* rows, int64_t count, Seen* bricks, int64_t num_bricks, int64_t* unique,
                        int32_t* position) {
    for (int64_t i = 0; i < count; i++) bricks[rows[i] >> 6].rows |= uint64_t(1) << (rows[i] & 63);
    int64_t found = 0;
    for (int64_t b = 0; b < num_bricks; b++) {
        bricks[b].before = found;
        for (uint64_t left = bricks[b].rows; left; left &= left - 1)
            unique[found++] = b * BRICK + __builtin_ctzll(left);
    }
    for (int64_t i = 0; i < count; i++) {
        const Seen& brick = bricks[rows[i] >> 6];
        const uint64_t earlier = brick.rows & ((uint64_t(1) << (rows[i] & 63)) - 1);
        position[i] = int32_t(brick.before + __builtin_popcountll(earlier));
    }
    return found;
}

// Rows [begin, end) of a list, read from the table; those that follow each other as one stretch.
void mmpi_take_rows(const int64_t* rows, int64_t begin, int64_t end, int64_t channels, const float* table,
                      float* values) {
    for (int64_t i = begin, next; i < end; i = next) {
        for (next = i + 1; next < end && rows[next] == rows[next - 1] + 1;) next++;
        for (int64_t soon = std::min(end, i + 2 * AHEAD); soon < std::min(end, next + 2 * AHEAD); soon++)
            prefetch_row(table + rows[soon] * channels, channels);
        std::copy_n(table + rows[i] * channels, (next - i) * channels, values + i * channels);
    }
}

// peaks[brick] is raised to the largest weight of the samples that read one of its rows.
void mmpi_raise_peaks(const int64_t* rows, const float* weights, int64_t samples, int64_t taps, float* peaks) {
    for (int64_t i = 0; i < samples * taps; i++) {
        float& peak = peaks[rows[i] / BRICK];
        peak = std::max(peak, weights[i / taps]);
    }
}

// values[position[n, b]] += weights[n, b] * grad[n], with weights of 1 where none are given.
void mmpi_sum_rows(const int32_t* position, const float* weights, const float* grad, int64_t samples, int64_t taps,
                       int64_t channels, float* values) {
    for (int64_t n = 0; n < samples; n++) {
        const float* from = grad + n * channels;
        for (int64_t b = 0; b < taps; b++) {
            float* to = values + int64_t(position[n * taps + b]) * channels;
            add_row(to, from, weights ? weights[n * taps + b] : 1.0f, channels);
        }
    }
}

// Rows and weights of bilinear lookups at (u, v, .) of `ndc` on planes of MPIs (TexelGrid.bilinear).
void mmpi_texel_rows(const Grid* grids, const int64_t* heads, const int64_t* planes, const float* ndc, int64_t count,
                     int64_t* rows, float* weights) {
    for (int64_t i = 0; i < count; i++) {
        const Grid& grid = grids[heads[i]];
        const Cell x(ndc[3 * i], grid.width), y(ndc[3 * i + 1], grid.height);
        const Corners corners(grid, planes[i], y.lower, x.lower);
        const float fx = x.fraction, fy = y.fraction, gx = 1 - fx, gy = 1 - fy;
        const float weight[4] = {gx * gy, fx * gy, gx * fy, fx * fy};
        for (int k = 0; k < 4; k++) {
            rows[4 * i + k] = corners.row[k];
            weights[4 * i + k] = weight[k];
        }
    }
}
}
