// Colours of samples, without gradients: features, position encoding and the colour network of a block of samples. The
// reference is reference.py.
#include "network.h"
#include "cells.h"
#include "table.h"

#include <memory>

namespace {

struct Shading {
    const float *features, *directions; // [rows, channels]; [R, 3]
    const int64_t *heads, *planes;      // [R, S]
    const float* ndc;                   // [R, S, 3]
    const bool* valid;                  // [R, S]
    int64_t rows, slots;
};

// What directions and the bias add to a network's first layer.
struct Start {
    const float *axes, *weights, *bias; // [3, 3]; [width, 3 (1 + 2 frequencies)]; [width]
    int64_t frequencies;
};

// A head's network, and samples that wait for their colours.
struct Head {
    Layers layers;
    Start start;
    Block block;
    Buffer weights, first; // of directions, [in, out]; what `ray` adds to the first layer
    int64_t ray = -1;
    int size = 0;
    int64_t slots[ROWS];

    Head(const Network& net, const Start& start)
        : layers(net), start(start), block(layers), weights(inputs() * layers.units),
          first(layers.units) {
        for (int64_t j = 0; j < net.width; j++)
            for (int64_t i = 0; i < inputs(); i++)
                weights.data()[i * layers.units + j] = start.weights[j * inputs() + i];
    }

    int64_t inputs() const { return 3 * (1 + 2 * start.frequencies); }

    void turn_to(int64_t new_ray, const float* direction) {
        ray = new_ray;
        float local[WIDTH] = {};
        for (int a = 0; a < 3; a++)
            for (int b = 0; b < 3; b++) local[a] += start.axes[3 * a + b] * direction[b];
        std::copy_n(start.bias, layers.net.width, first.data());
        add(0, load(local));
        Lanes sine, cosine;
        sincos_turn(least(most(load(local), splat(-1)), splat(1)), sine, cosine);
        for (int64_t i = 0; i < start.frequencies; i++) {
            add(3 + 3 * i, sine);
            add(3 + 3 * (start.frequencies + i), cosine);
            const Lanes twice = 2.0f * sine * cosine;
            cosine = 1.0f - 2.0f * sine * sine;
            sine = twice;
        }
    }

    // Adds what three inputs from `place` on give.
    void add(int64_t place, Lanes numbers) {
        float input[WIDTH];
        store(input, numbers);
        const Matrix from{weights.data() + place * layers.units, layers.units};
        multiply(input, 0, 1, from, 3, {first.data(), 0}, 1, layers.units);
    }

    void take(int64_t slot, const float* ndc) {
        std::copy_n(first.data(), layers.units, block.hidden.row(size));
        for (int a = 0; a < 3; a++) block.position[a][size] = ndc[a];
        slots[size++] = slot;
    }
};

// What a sample reads: up to eight rows of the table and their weights.
struct Taps {
    int64_t rows[8];
    float weights[8];

    // The four texels around a place in layer `first / 4`.
    void put(int first, const int64_t* corners, float fx, float fy, float share) {
        for (int i = 0; i < 4; i++) {
            rows[first + i] = corners[i];
            weights[first + i] = (i & 1 ? fx : 1 - fx) * (i >> 1 ? fy : 1 - fy) * share;
        }
    }
};

void find_in_mpi(const Grid& grid, const int64_t* planes, const Head& head, Taps* taps) {
    for (int first = 0; first < head.size; first += WIDTH) {
        IntLanes plane{};
        const int count = std::min(WIDTH, head.size - first);
        for (int i = 0; i < count; i++) plane[i] = int32_t(planes[head.slots[first + i]]);
        const PlaneCells at(grid, load(head.block.position[0] + first), load(head.block.position[1] + first), plane);
        for (int i = 0; i < count; i++) {
            if (at.edge[i]) {
                const Corners corners(grid, plane[i], at.line[i], at.column[i]);
                taps[first + i].put(0, corners.row, at.fx[i], at.fy[i], 1);
                continue;
            }
            const int64_t row = int64_t(grid.tiles[grid.first_tile + at.tile[i]]) * BRICK + at.texel[i];
            const int64_t corners[4] = {row, row + 1, row + 8, row + 9};
            taps[first + i].put(0, corners, at.fx[i], at.fy[i], 1);
        }
    }
}

void find_in_cube(const Grid& grid, const Head& head, Taps* taps) {
    for (int i = 0; i < head.size; i++) {
        const Cell x(head.block.position[0][i], grid.width), y(head.block.position[1][i], grid.height);
        const Cell z(head.block.position[2][i], grid.depth);
        taps[i].put(0, Corners(grid, z.lower, y.lower, x.lower).row, x.fraction, y.fraction, 1 - z.fraction);
        taps[i].put(4, Corners(grid, z.lower + 1, y.lower, x.lower).row, x.fraction, y.fraction, z.fraction);
    }
}

// Features of the samples. Where they lie is found first, so that memory is asked for all of them at once.
void gather(const Grid& grid, bool in_cube, const Shading& shading, Head& head) {
    const Table table{shading.features, shading.rows, head.layers.net.channels};
    const int count = in_cube ? 8 : 4;
    Taps taps[ROWS];
    if (in_cube)
        find_in_cube(grid, head, taps);
    else
        find_in_mpi(grid, shading.planes, head, taps);
    for (int i = 0; i < head.size; i++)
        for (int tap = 0; tap < count; tap++) table.prefetch(taps[i].rows[tap]);
    for (int i = 0; i < head.size; i++)
        for (int64_t c = 0; c < table.channels; c += WIDTH) {
            Lanes sum{};
            for (int tap = 0; tap < count; tap++)
                sum += taps[i].weights[tap] * table.read(taps[i].rows[tap] * table.channels + c);
            store(head.block.x.row(i) + c, sum);
        }
}

void shade(const Grid& grid, bool in_cube, const Shading& shading, Head& head, float* colors) {
    gather(grid, in_cube, shading, head);
    run(head.layers, head.block);
    for (int i = 0; i < head.size; i++)
        for (int a = 0; a < 3; a++) colors[3 * head.slots[i] + a] = head.block.colors[a][i];
    head.size = 0;
}

} // namespace

extern "C" {

// Colours [R, S, 3] of the valid samples of rays [begin, end); empty slots become black. One network and start a head.
void mmpi_shade(const Grid* grids, int64_t num_mpis, int64_t num_heads, const Shading* shading, const Network* networks,
                const Start* starts, int64_t begin, int64_t end, float* colors) {
    std::vector<std::unique_ptr<Head>> heads;
    for (int64_t h = 0; h < num_heads; h++) heads.push_back(std::make_unique<Head>(networks[h], starts[h]));
    const auto shade_head = [&](int64_t h) { shade(grids[h], h >= num_mpis, *shading, *heads[h], colors); };
    std::fill(colors + 3 * begin * shading->slots, colors + 3 * end * shading->slots, 0.0f);
    for (int64_t ray = begin; ray < end; ray++)
        for (int64_t slot = ray * shading->slots; slot < (ray + 1) * shading->slots; slot++) {
            if (!shading->valid[slot]) continue;
            const int64_t h = shading->heads[slot];
            if (heads[h]->ray != ray) heads[h]->turn_to(ray, shading->directions + 3 * ray);
            heads[h]->take(slot, shading->ndc + 3 * slot);
            if (heads[h]->size == ROWS) shade_head(h);
        }
    for (int64_t h = 0; h < num_heads; h++)
        if (heads[h]->size) shade_head(h);
}
}
