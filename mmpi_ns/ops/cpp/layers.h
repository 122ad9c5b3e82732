// Small networks on sixteen samples at once, a lane a sample.
#pragma once
#include "lanes.h"

#include <algorithm>
#include <utility>
#include <vector>

struct Layer {
    int64_t outputs, inputs;
    const float *weights, *biases; // [outputs, inputs], [outputs]
};

// Eight sums at once, so that none waits for another. What is not a number stays so.
inline void run(const Layer& layer, const Lanes* from, Lanes* to, bool last) {
    constexpr int64_t MANY = 8;
    for (int64_t o = 0; o < layer.outputs; o += MANY) {
        const int64_t some = std::min(MANY, layer.outputs - o);
        const float* rows[MANY];
        Lanes sums[MANY];
        for (int64_t j = 0; j < MANY; j++) {
            const int64_t row = o + std::min(j, some - 1);
            rows[j] = layer.weights + row * layer.inputs;
            sums[j] = splat(layer.biases[row]);
        }
        for (int64_t i = 0; i < layer.inputs; i++)
            for (int j = 0; j < MANY; j++) sums[j] += from[i] * rows[j][i];
        for (int64_t j = 0; j < some; j++) to[o + j] = last || !(sums[j] < 0) ? sums[j] : Lanes{};
    }
}

// All layers; inputs are in `now`, and so are the outputs.
inline void run(const Layer* layers, int64_t count, std::vector<Lanes>& now, std::vector<Lanes>& next) {
    for (int64_t l = 0; l < count; l++) {
        next.resize(std::max<int64_t>(next.size(), layers[l].outputs));
        run(layers[l], now.data(), next.data(), l + 1 == count);
        std::swap(now, next);
    }
}

inline int64_t encoded(int64_t octaves) { return 3 * (1 + 2 * octaves); }

// (x, sin 2^i pi x, cos 2^i pi x) of three numbers in [-1, 1], in the order of shade.positional_encoding.
inline void encode(const Lanes* x, int64_t octaves, Lanes* to) {
    for (int a = 0; a < 3; a++) {
        Lanes sine, cosine;
        to[a] = x[a];
        sincos_turn(least(most(x[a], splat(-1)), splat(1)), sine, cosine);
        for (int64_t i = 0; i < octaves; i++) {
            to[3 + 3 * i + a] = sine, to[3 + 3 * (octaves + i) + a] = cosine;
            const Lanes twice = 2.0f * sine * cosine;
            cosine = 1.0f - 2.0f * sine * sine;
            sine = twice;
        }
    }
}
