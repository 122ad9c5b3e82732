// What the kernels know of a plan: MPIs first, the cube last. Filled by ops/march.py, field by field.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

struct Mpi {
    float step;        // disparity between neighbouring planes
    float end;         // disparity of the last plane, 1 / far; 0 at infinity
    float share;       // 1 - near / far
    float s_scale;     // 2 * near / share: ndc s = 1 - (w - end) * s_scale
    float u0, u_scale; // ndc u = (u - u0) * u_scale - 1
    float v0, v_scale;
    float interval; // factor on softplus
};

struct Grid {
    int64_t offset, depth, height, width; // block of the pooled tables
    int64_t bias;                         // where an MPI's plane biases start
};

struct Cube {
    float lower[3], extent[3]; // extent = upper - lower
    float step, bias, interval;
};

struct Scene {
    int64_t num_mpis, num_heads; // heads = MPIs, and the cube where there is one
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
    Cell(float coordinate, int64_t size) {
        const float last = float(size - 1);
        float position = (coordinate + 1) * (0.5f * last);
        position = std::min(std::max(position, 0.0f), last);
        const float floor = std::min(std::floor(position), last - 1);
        lower = int64_t(floor);
        fraction = position - floor;
    }
};

inline float bilinear(const float* table, const Grid& grid, int64_t layer, const Cell& x, const Cell& y) {
    const float* row = table + grid.offset + (layer * grid.height + y.lower) * grid.width + x.lower;
    const float* next = row + grid.width;
    const float fx = x.fraction, fy = y.fraction, gx = 1 - fx, gy = 1 - fy;
    return gx * gy * row[0] + fx * gy * row[1] + gx * fy * next[0] + fx * fy * next[1];
}

inline float trilinear(const float* table, const Grid& grid, const float* ndc) {
    const Cell x(ndc[0], grid.width), y(ndc[1], grid.height), z(ndc[2], grid.depth);
    return bilinear(table, grid, z.lower, x, y) * (1 - z.fraction) +
           bilinear(table, grid, z.lower + 1, x, y) * z.fraction;
}

inline int64_t nearest_texel(const Grid& grid, const float* ndc) {
    const int64_t sizes[3] = {grid.width, grid.height, grid.depth};
    int64_t index[3];
    for (int i = 0; i < 3; i++) {
        const float last = float(sizes[i] - 1);
        index[i] = int64_t(std::min(std::max(std::nearbyint((ndc[i] + 1) * (0.5f * last)), 0.0f), last));
    }
    return grid.offset + (index[2] * grid.height + index[1]) * grid.width + index[0];
}
