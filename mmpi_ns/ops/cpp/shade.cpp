// Colours of samples, without gradients: features, position encoding and the colour network of a block of samples. The
// reference is ColorNetworks.forward.
#include "network.h"
#include "scene.h"
#include "table.h"

#include <memory>

namespace {

struct Shading {
    const float* features;         // [rows, channels]
    const float* start;            // [H, R, width]: what bias and direction of a ray add to the first layer
    const int64_t *heads, *planes; // [R, S]
    const float* ndc;              // [R, S, 3]
    const bool* valid;             // [R, S]
    int64_t rows, num_rays, slots;
};

// Samples of one head that wait for their colours.
struct Batch {
    int size = 0;
    int64_t slots[ROWS];
};

// Features of the samples. Where they lie is found first, so that memory is asked for all of them at once.
void gather(const Scene& scene, const Shading& shading, const Table& table, int64_t head, const Batch& batch, Matrix x) {
    const Grid& grid = scene.grids[head];
    const bool in_cube = head >= scene.num_mpis;
    const int taps = in_cube ? 8 : 4;
    int64_t rows[ROWS][8];
    float weights[ROWS][8];
    for (int i = 0; i < batch.size; i++) {
        const int64_t slot = batch.slots[i];
        const float* ndc = shading.ndc + 3 * slot;
        const Cell cx(ndc[0], grid.width), cy(ndc[1], grid.height);
        const Cell cz(in_cube ? ndc[2] : -1, std::max<int64_t>(grid.depth, 2));
        const int64_t layer = in_cube ? cz.lower : shading.planes[slot];
        for (int first = 0; first < taps; first += 4) {
            const Corners corners(grid, layer + first / 4, cy.lower, cx.lower);
            for (int tap = 0; tap < 4; tap++) {
                rows[i][first + tap] = corners.row[tap];
                weights[i][first + tap] = (tap & 1 ? cx.fraction : 1 - cx.fraction) *
                                          (tap >> 1 ? cy.fraction : 1 - cy.fraction) *
                                          (first ? cz.fraction : 1 - cz.fraction);
                table.prefetch(corners.row[tap]);
            }
        }
    }
    for (int i = 0; i < batch.size; i++)
        for (int64_t c = 0; c < table.channels; c += WIDTH) {
            Lanes sum{};
            for (int tap = 0; tap < taps; tap++)
                sum += weights[i][tap] * table.read(rows[i][tap] * table.channels + c);
            store(x.row(i) + c, sum); // lanes beyond the features are overwritten by the encoding
        }
}

void shade(const Scene& scene, const Shading& shading, const Layers& layers, int64_t head, Batch& batch, Block& block,
           float* colors) {
    gather(scene, shading, {shading.features, shading.rows, layers.net.channels}, head, batch, block.x);
    for (int i = 0; i < batch.size; i++) {
        const int64_t slot = batch.slots[i], width = layers.net.width;
        const float* start = shading.start + (head * shading.num_rays + slot / shading.slots) * width;
        std::copy(start, start + width, block.hidden.row(i));
        for (int a = 0; a < 3; a++) block.position[a][i] = shading.ndc[3 * slot + a];
    }
    run(layers, block);
    for (int i = 0; i < batch.size; i++)
        for (int a = 0; a < 3; a++) colors[3 * batch.slots[i] + a] = block.colors[a][i];
    batch.size = 0;
}

} // namespace

extern "C" {

// Colours [R, S, 3] of the valid samples of rays [begin, end); empty slots become black. One network a head.
void mmpi_shade(const Scene* scene, const Shading* shading, const Network* networks, int64_t begin, int64_t end,
                float* colors) {
    std::vector<Batch> batches(scene->num_heads);
    std::vector<std::unique_ptr<Layers>> layers;
    for (int64_t head = 0; head < scene->num_heads; head++) layers.push_back(std::make_unique<Layers>(networks[head]));
    Block block(layers[0]->inputs, layers[0]->units);
    for (int64_t slot = begin * shading->slots; slot < end * shading->slots; slot++) {
        for (int a = 0; a < 3; a++) colors[3 * slot + a] = 0;
        if (!shading->valid[slot]) continue;
        const int64_t head = shading->heads[slot];
        Batch& batch = batches[head];
        batch.slots[batch.size++] = slot;
        if (batch.size == ROWS) shade(*scene, *shading, *layers[head], head, batch, block, colors);
    }
    for (int64_t head = 0; head < scene->num_heads; head++)
        if (batches[head].size) shade(*scene, *shading, *layers[head], head, batches[head], block, colors);
}
}
