// Colours of samples, without gradients: features, encodings and the colour network of sixteen samples of a head at a
// time.
#include "layers.h"
#include "parts.h"
#include "taps.h"

namespace {

struct Shading {
    const float *axes, *features, *directions; // [H, 3, 3]; [rows, channels]; [R, 3]
    const int64_t *heads, *planes;             // [R, S]
    const float* ndc;                          // [R, S, 3]
    const bool* valid;                         // [R, S]
    int64_t rows, channels, slots, position_octaves, direction_octaves;
};

constexpr int DEPTH = 3; // layers of a network

// Samples of a head that wait for their colours, a lane each.
struct Waiting {
    std::vector<Lanes> inputs, scratch;
    int64_t slots[WIDTH];
    Sample samples[WIDTH];
    int size = 0;
};

void shade(const Shading& shading, const Layer* layers, Waiting& head, float* colors) {
    const Table table{shading.features, shading.rows, shading.channels};
    const int64_t places = table.channels + encoded(shading.position_octaves);
    head.inputs.resize(places + encoded(shading.direction_octaves));
    Lanes position[3] = {}, direction[3] = {};
    for (int i = 0; i < head.size; i++) {
        for (int64_t first = 0; first < table.channels; first += WIDTH) {
            const Lanes read = interpolate(table, head.samples[i], first);
            for (int64_t c = first; c < std::min(table.channels, first + WIDTH); c++) head.inputs[c][i] = read[c - first];
        }
        const float* toward = shading.directions + 3 * (head.slots[i] / shading.slots);
        const float* axes = shading.axes + 9 * shading.heads[head.slots[i]];
        for (int a = 0; a < 3; a++) {
            position[a][i] = shading.ndc[3 * head.slots[i] + a];
            direction[a][i] = axes[3 * a] * toward[0] + axes[3 * a + 1] * toward[1] + axes[3 * a + 2] * toward[2];
        }
    }
    encode(position, shading.position_octaves, head.inputs.data() + table.channels);
    encode(direction, shading.direction_octaves, head.inputs.data() + places);
    const Lanes diffuse[3] = {head.inputs[0], head.inputs[1], head.inputs[2]};
    run(layers, DEPTH, head.inputs, head.scratch);
    for (int a = 0; a < 3; a++) {
        const Lanes logit = diffuse[a] + head.inputs[a], color = 1.0f / (1.0f + exp_lanes(-logit));
        for (int i = 0; i < head.size; i++) colors[3 * head.slots[i] + a] = logit[i] == logit[i] ? color[i] : logit[i];
    }
    head.size = 0;
}

// Colours [R, S, 3] of the valid samples of rays [begin, end); empty slots become black. DEPTH layers a head.
void mmpi_shade(int64_t begin, int64_t end, const Grid* grids, int64_t num_mpis, int64_t num_heads,
                const Shading* shading, const Layer* layers, float* colors) {
    std::vector<Waiting> heads(num_heads);
    const auto shade_head = [&](int64_t h) { shade(*shading, layers + DEPTH * h, heads[h], colors); };
    std::fill(colors + 3 * begin * shading->slots, colors + 3 * end * shading->slots, 0.0f);
    for (int64_t slot = begin * shading->slots; slot < end * shading->slots; slot++) {
        if (!shading->valid[slot]) continue;
        const int64_t h = shading->heads[slot];
        Waiting& head = heads[h];
        Sample& sample = head.samples[head.size] = Sample();
        sample.put(grids[h], h >= num_mpis, shading->planes[slot], shading->ndc + 3 * slot);
        prefetch({shading->features, shading->rows, shading->channels}, sample);
        head.slots[head.size++] = slot;
        if (head.size == WIDTH) shade_head(h);
    }
    for (int64_t h = 0; h < num_heads; h++)
        if (heads[h].size) shade_head(h);
}

} // namespace

IN_PARTS(mmpi_shade)
