// Plan data of the kernels: MPIs first, the cube last. Filled by ops/layout.py, field by field.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

// Of an MPI (layout.constants).
struct Mpi {
    float origin[3], axes[3][3], extent[4]; // u0, u1, v0, v1
    float step, end, last; // disparity between planes and of the last one, 1 / far (0 at infinity); number of the first one
    float share;           // 1 - near / far
    float s_scale;         // 2 * near / share: ndc s = 1 - (w - end) * s_scale
    float u0, u_scale;     // ndc u = (u - u0) * u_scale - 1
    float v0, v_scale;
    float interval; // factor on softplus
};

// A head's texels, in bricks of 8 x 8 on one plane (texels.py).
struct Grid {
    int64_t depth, height, width;
    int64_t down, across; // tiles of a plane
    int64_t first_tile;   // where the head's tiles begin among those of all heads
    const int32_t* tiles; // brick of every tile of all heads; 0 where nothing is stored
    int64_t bias;         // where an MPI's plane biases start

    const int32_t* tile(int64_t z, int64_t y, int64_t x) const {
        return tiles + first_tile + (z * down + (y >> 3)) * across + (x >> 3);
    }
};

constexpr int64_t BRICK = 64;

inline int64_t row_in_brick(int32_t brick, int64_t y, int64_t x) {
    return int64_t(brick) * BRICK + ((y & 7) << 3) + (x & 7);
}

struct Cube {
    float lower[3], extent[3]; // extent = upper - lower
    float step, bias, interval;
    float upper[3];
};

struct Scene {
    int64_t num_mpis, num_heads; // heads = MPIs, and the cube where there is one
    float content_near;          // distance to the first content
    const Mpi* mpis;
    const Grid* grids;
    const float* biases;
    const Cube* cube; // null without one
    const float* density;
    const float* reliability;
    const uint8_t* touched;
};

// Lower texel and fraction of a coordinate in [-1, 1] over `size` texels; outside it clamps to the border.
struct Cell {
    int64_t lower;
    float fraction;

    Cell(int64_t lower, float fraction) : lower(lower), fraction(fraction) {}

    Cell(float coordinate, int64_t size) {
        const float last = float(size - 1);
        float position = (coordinate + 1) * (0.5f * last);
        position = std::min(std::max(0.0f, position), last); // in this order NaN becomes 0
        const float floor = std::min(std::floor(position), last - 1);
        lower = int64_t(floor);
        fraction = position - floor;
    }
};

// Rows of the four texels around a position on a plane, and whether any is stored.
struct Corners {
    int64_t row[4]; // (y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)
    bool stored;
    Corners(const Grid& grid, int64_t layer, int64_t y, int64_t x) {
        const int32_t* tile = grid.tile(layer, y, x);
        const int64_t right = (x & 7) == 7, below = (y & 7) == 7 ? grid.across : 0;
        const int32_t bricks[4] = {tile[0], tile[right], tile[below], tile[below + right]};
        for (int i = 0; i < 4; i++) row[i] = row_in_brick(bricks[i], y + (i >> 1), x + (i & 1));
        stored = bricks[0] | bricks[1] | bricks[2] | bricks[3];
    }
};

inline float blend(const float* table, const Corners& corners, const Cell& x, const Cell& y) {
    const float fx = x.fraction, fy = y.fraction, gx = 1 - fx, gy = 1 - fy;
    const int64_t* row = corners.row;
    return gx * gy * table[row[0]] + fx * gy * table[row[1]] + gx * fy * table[row[2]] + fx * fy * table[row[3]];
}
