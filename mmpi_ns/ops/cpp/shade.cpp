// Colours of samples, without gradients: features, position encoding and the colour network of sixteen samples at once.
// The reference is ColorNetworks.forward.
#include "lanes.h"
#include "scene.h"

#include <vector>

namespace {

struct Network {
    int64_t channels, frequencies, width; // features, octaves of the position encoding, width of the hidden layers
    const float *first, *second, *second_bias, *third, *third_bias;
    // first: [width, channels + 3 (1 + 2 frequencies)], the part for directions and bias being in `Shading::start`
};

struct Shading {
    const float* features;      // [T, channels]
    const float* start;         // [H, R, width]: what bias and direction of a ray add to the first layer
    const int64_t *heads, *planes; // [R, S]
    const float* ndc;           // [R, S, 3]
    const bool* valid;          // [R, S]
    int64_t num_rays, slots;
};

// Samples of one head that wait for their colours.
struct Batch {
    int size = 0;
    int64_t slots[WIDTH];
};

// out[j] = start[j] + sum_i weights[j, i] in[i], four rows at a time.
void layer(const float* weights, const Lanes* in, int64_t inputs, Lanes* out, int64_t outputs) {
    int64_t j = 0;
    for (; j + 4 <= outputs; j += 4) {
        const float* w = weights + j * inputs;
        Lanes a = out[j], b = out[j + 1], c = out[j + 2], d = out[j + 3];
        for (int64_t i = 0; i < inputs; i++) {
            const Lanes x = in[i];
            a += w[i] * x;
            b += w[inputs + i] * x;
            c += w[2 * inputs + i] * x;
            d += w[3 * inputs + i] * x;
        }
        out[j] = a, out[j + 1] = b, out[j + 2] = c, out[j + 3] = d;
    }
    for (; j < outputs; j++)
        for (int64_t i = 0; i < inputs; i++) out[j] += weights[j * inputs + i] * in[i];
}

void relu(Lanes* x, int64_t count) {
    for (int64_t i = 0; i < count; i++) x[i] = most(x[i], Lanes{});
}

// Features of the samples, channels first: lanes of x[c] are the batch's samples. Where they lie is found first, so
// that memory is asked for all of them at once.
void gather(const Scene& scene, const Shading& shading, int64_t channels, int64_t head, const Batch& batch, Lanes* x) {
    const Grid& grid = scene.grids[head];
    const bool in_cube = head >= scene.num_mpis;
    const int taps = in_cube ? 8 : 4;
    int64_t rows[WIDTH][8];
    float weights[WIDTH][8];
    for (int lane = 0; lane < batch.size; lane++) {
        const int64_t slot = batch.slots[lane];
        const float* ndc = shading.ndc + 3 * slot;
        const Cell cx(ndc[0], grid.width), cy(ndc[1], grid.height);
        const Cell cz(in_cube ? ndc[2] : -1, std::max<int64_t>(grid.depth, 2));
        const int64_t layer = in_cube ? cz.lower : shading.planes[slot];
        for (int first = 0; first < taps; first += 4) {
            const Corners corners(grid, layer + first / 4, cy.lower, cx.lower);
            for (int tap = 0; tap < 4; tap++) {
                rows[lane][first + tap] = corners.row[tap] * channels;
                weights[lane][first + tap] = (tap & 1 ? cx.fraction : 1 - cx.fraction) *
                                             (tap >> 1 ? cy.fraction : 1 - cy.fraction) *
                                             (first ? cz.fraction : 1 - cz.fraction);
                __builtin_prefetch(shading.features + rows[lane][first + tap]);
            }
        }
    }
    for (int64_t c = 0; c < channels; c++) x[c] = Lanes{};
    for (int lane = 0; lane < batch.size; lane++)
        for (int tap = 0; tap < taps; tap++) {
            const float *texel = shading.features + rows[lane][tap], weight = weights[lane][tap];
            for (int64_t c = 0; c < channels; c++) x[c][lane] += weight * texel[c];
        }
}

// (x, sin 2^i pi x, cos 2^i pi x) in the order of color_network.positional_encoding.
void encode(const Shading& shading, const Batch& batch, int64_t frequencies, Lanes* x) {
    for (int a = 0; a < 3; a++) {
        Lanes position = Lanes{}, sine, cosine;
        for (int lane = 0; lane < batch.size; lane++) position[lane] = shading.ndc[3 * batch.slots[lane] + a];
        x[a] = position;
        sincos_turn(least(most(position, splat(-1)), splat(1)), sine, cosine);
        for (int64_t i = 0; i < frequencies; i++) {
            x[3 + 3 * i + a] = sine;
            x[3 + 3 * (frequencies + i) + a] = cosine;
            const Lanes twice = 2.0f * sine * cosine;
            cosine = 1.0f - 2.0f * sine * sine;
            sine = twice;
        }
    }
}

void shade(const Scene& scene, const Shading& shading, const Network& net, int64_t head, Batch& batch,
           std::vector<Lanes>& scratch, float* colors) {
    const int64_t inputs = net.channels + 3 * (1 + 2 * net.frequencies), width = net.width;
    Lanes *x = scratch.data(), *hidden = x + inputs, *second = hidden + width;
    gather(scene, shading, net.channels, head, batch, x);
    encode(shading, batch, net.frequencies, x + net.channels);
    for (int lane = 0; lane < batch.size; lane++) {
        const float* start = shading.start + (head * shading.num_rays + batch.slots[lane] / shading.slots) * width;
        for (int64_t j = 0; j < width; j++) hidden[j][lane] = start[j];
    }
    layer(net.first, x, inputs, hidden, width);
    relu(hidden, width);
    for (int64_t j = 0; j < width; j++) second[j] = splat(net.second_bias[j]);
    layer(net.second, hidden, width, second, width);
    relu(second, width);
    Lanes rgb[3];
    for (int a = 0; a < 3; a++) rgb[a] = x[a] + net.third_bias[a];
    layer(net.third, second, width, rgb, 3);
    for (int a = 0; a < 3; a++) {
        const Lanes color = 1.0f / (1.0f + exp_lanes(-rgb[a]));
        for (int lane = 0; lane < batch.size; lane++) colors[3 * batch.slots[lane] + a] = color[lane];
    }
    batch.size = 0;
}

} // namespace

extern "C" {

// Colours [R, S, 3] of the valid samples of rays [begin, end); empty slots become black. One network a head.
void mmpi_shade(const Scene* scene, const Shading* shading, const Network* networks, int64_t begin, int64_t end,
                float* colors) {
    std::vector<Batch> batches(scene->num_heads);
    const int64_t inputs = networks->channels + 3 * (1 + 2 * networks->frequencies);
    std::vector<Lanes> scratch(inputs + 2 * networks->width);
    for (int64_t slot = begin * shading->slots; slot < end * shading->slots; slot++) {
        for (int a = 0; a < 3; a++) colors[3 * slot + a] = 0;
        if (!shading->valid[slot]) continue;
        const int64_t head = shading->heads[slot];
        Batch& batch = batches[head];
        batch.slots[batch.size++] = slot;
        if (batch.size == WIDTH) shade(*scene, *shading, networks[head], head, batch, scratch, colors);
    }
    for (int64_t head = 0; head < scene->num_heads; head++)
        if (batches[head].size) shade(*scene, *shading, networks[head], head, batches[head], scratch, colors);
}
}
