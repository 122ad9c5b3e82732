// The network that shades a ray once (scene.py, Shader), sixteen rays at a time.
#include "lanes.h"
#include "parts.h"

#include <algorithm>
#include <utility>
#include <vector>

namespace {

// sin(pi x) for |x| <= 1/2 (its Taylor series: 6e-8 at the ends).
Lanes sin_half_turn(Lanes x) {
    const Lanes z = x * 3.14159265f, q = z * z;
    Lanes p = splat(-1.0f / 39916800);
    p = p * q + 1.0f / 362880;
    p = p * q - 1.0f / 5040;
    p = p * q + 1.0f / 120;
    p = p * q - 1.0f / 6;
    return z + z * q * p;
}

// sin(pi x) and cos(pi x) for |x| <= 1.
void sincos_turn(Lanes x, Lanes& sine, Lanes& cosine) {
    const Lanes size = magnitude(x), folded = least(size, 1.0f - size);
    const Lanes s = sin_half_turn(folded);
    sine = x < 0 ? -s : s;
    cosine = sin_half_turn(0.5f - size);
}

struct Layer {
    int64_t outputs, inputs;
    const float *weights, *biases; // [outputs, inputs], [outputs]
};

// Eight sums at once, so that none waits for another. What is not a number stays so.
void run(const Layer& layer, const Lanes* from, Lanes* to, bool last) {
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
void run(const Layer* layers, int64_t count, std::vector<Lanes>& now, std::vector<Lanes>& next) {
    for (int64_t l = 0; l < count; l++) {
        next.resize(std::max<int64_t>(next.size(), layers[l].outputs));
        run(layers[l], now.data(), next.data(), l + 1 == count);
        std::swap(now, next);
    }
}

int64_t encoded(int64_t octaves) { return 3 * (1 + 2 * octaves); }

// (x, sin 2^i pi x, cos 2^i pi x) of three numbers in [-1, 1], in the order of positional_encoding.
void encode(const Lanes* x, int64_t octaves, Lanes* to) {
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

// Colours of rays [begin, end): the network sees the means of what each gathered, and the direction.
void mmpi_shade_baked(int64_t begin, int64_t end, const Layer* layers, int64_t num_layers, int64_t channels,
                      int64_t octaves, float bound, const float* sums, const float* mass, const float* directions,
                      float* rgb) {
    std::vector<Lanes> now, next;
    for (int64_t first = begin; first < end; first += WIDTH) {
        const int64_t rays = std::min<int64_t>(WIDTH, end - first);
        const auto column = [&](const float* table, int64_t stride, int64_t at) {
            Lanes x{};
            for (int64_t r = 0; r < rays; r++) x[r] = table[(first + r) * stride + at];
            return x;
        };
        now.resize(std::max<int64_t>(now.size(), channels + encoded(octaves)));
        const Lanes total = most(column(mass, 1, 0), splat(1e-6f));
        for (int64_t c = 0; c < channels; c++) now[c] = column(sums, channels, c) / total;
        const Lanes mean[3] = {now[0], now[1], now[2]};
        const Lanes direction[3] = {column(directions, 3, 0), column(directions, 3, 1), column(directions, 3, 2)};
        encode(direction, octaves, now.data() + channels);
        run(layers, num_layers, now, next);
        for (int64_t a = 0; a < 3; a++) {
            const Lanes turned = 1.0f - 2.0f / (exp_lanes(now[a] * (2 / bound)) + 1.0f); // tanh
            const Lanes color = mean[a] / (mean[a] + (1.0f - mean[a]) * exp_lanes(-bound * turned));
            for (int64_t r = 0; r < rays; r++) rgb[(first + r) * 3 + a] = color[r];
        }
    }
}

} // namespace

IN_PARTS(mmpi_shade_baked)
