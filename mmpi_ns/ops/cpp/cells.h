// Where lookups in MPIs lie, sixteen at once.
#pragma once
#include "lanes.h"
#include "scene.h"

// Lower texels and fractions of sixteen coordinates in [-1, 1] (as Cell).
inline void cells(Lanes coordinate, int64_t size, IntLanes& lower, Lanes& fraction) {
    const float last = float(size - 1);
    const Lanes position = least(most((coordinate + 1.0f) * (0.5f * last), Lanes{}), splat(last));
    lower = __builtin_convertvector(position, IntLanes); // towards zero, and positions are not negative
    const IntLanes highest = int32_t(size - 2) - IntLanes{};
    lower = lower < highest ? lower : highest;
    fraction = position - __builtin_convertvector(lower, Lanes);
}

// Where sixteen samples lie on planes of an MPI, and the texels at their lower corners.
struct PlaneCells {
    int32_t column[WIDTH], line[WIDTH], tile[WIDTH], texel[WIDTH], edge[WIDTH]; // edge: corners lie in several bricks
    float fx[WIDTH], fy[WIDTH];

    PlaneCells(const Grid& grid, Lanes x, Lanes y, IntLanes plane) {
        IntLanes lower_x, lower_y;
        Lanes fraction_x, fraction_y;
        cells(x, grid.width, lower_x, fraction_x);
        cells(y, grid.height, lower_y, fraction_y);
        const IntLanes in_x = lower_x & 7, in_y = lower_y & 7;
        store(column, lower_x), store(line, lower_y);
        store(tile, (plane * int32_t(grid.down) + (lower_y >> 3)) * int32_t(grid.across) + (lower_x >> 3));
        store(texel, (in_y << 3) + in_x);
        store(edge, (in_x == 7) | (in_y == 7));
        store(fx, fraction_x), store(fy, fraction_y);
    }

    static void store(int32_t* to, IntLanes x) { __builtin_memcpy(to, &x, sizeof x); }
    static void store(float* to, Lanes x) { ::store(to, x); }
};
