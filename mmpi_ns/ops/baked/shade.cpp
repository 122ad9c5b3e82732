// The network that shades a ray once (rendering/baked.py, Shader), sixteen rays at a time.
#include "lanes.h"

#include <algorithm>
#include <vector>

namespace {

constexpr float TWO_PI_TURNS = 0.5f; // of a half turn pi: sincos_turn takes |x| <= 1, so x is taken modulo 2

struct Layer {
    int64_t outputs, inputs;
    const float *weights, *biases; // [outputs, inputs], [outputs]
};

// Four sums at once, so that one does not wait for the other.
void run(const Layer& layer, const Lanes* from, Lanes* to, bool last) {
    for (int64_t o = 0; o < layer.outputs; o += 4) {
        const int64_t some = std::min<int64_t>(4, layer.outputs - o);
        const float* rows[4];
        Lanes sums[4];
        for (int64_t j = 0; j < 4; j++) {
            const int64_t row = o + std::min(j, some - 1);
            rows[j] = layer.weights + row * layer.inputs;
            sums[j] = splat(layer.biases[row]);
        }
        for (int64_t i = 0; i < layer.inputs; i++)
            for (int j = 0; j < 4; j++) sums[j] += from[i] * rows[j][i];
        for (int64_t j = 0; j < some; j++) to[o + j] = last ? sums[j] : most(sums[j], Lanes{});
    }
}

Lanes modulo_two(Lanes x) {
    const Lanes magic = splat(12582912.0f); // adding it rounds to an integer
    return x - 2.0f * ((x * TWO_PI_TURNS + magic) - magic);
}

} // namespace

extern "C" {

// Colours of rays [begin, end): the network sees the means of what each gathered, and the direction.
void mmpi_shade_baked(const Layer* layers, int64_t num_layers, int64_t channels, int64_t octaves, float bound,
                      const float* sums, const float* mass, const float* directions, int64_t begin, int64_t end,
                      float* rgb) {
    int64_t widest = channels + 3 * (1 + 2 * octaves);
    for (int64_t l = 0; l < num_layers; l++) widest = std::max(widest, layers[l].outputs);
    std::vector<Lanes> now(widest), next(widest);
    for (int64_t first = begin; first < end; first += WIDTH) {
        const int64_t rays = std::min<int64_t>(WIDTH, end - first);
        const auto column = [&](const float* table, int64_t stride, int64_t at) {
            Lanes x{};
            for (int64_t r = 0; r < rays; r++) x[r] = table[(first + r) * stride + at];
            return x;
        };
        const Lanes total = most(column(mass, 1, 0), splat(1e-6f));
        for (int64_t c = 0; c < channels; c++) now[c] = column(sums, channels, c) / total;
        const Lanes mean[3] = {now[0], now[1], now[2]};
        for (int64_t a = 0; a < 3; a++) {
            const Lanes d = column(directions, 3, a);
            now[channels + a] = d;
            for (int64_t i = 0; i < octaves; i++) {
                Lanes &sine = now[channels + 3 + 3 * i + a], &cosine = now[channels + 3 + 3 * octaves + 3 * i + a];
                sincos_turn(modulo_two(d * float(int64_t(1) << i)), sine, cosine);
            }
        }
        for (int64_t l = 0; l < num_layers; l++) {
            run(layers[l], now.data(), next.data(), l + 1 == num_layers);
            now.swap(next);
        }
        for (int64_t a = 0; a < 3; a++) {
            const Lanes turned = 1.0f - 2.0f / (exp_lanes(now[a] * (2 / bound)) + 1.0f); // tanh
            const Lanes color = mean[a] / (mean[a] + (1.0f - mean[a]) * exp_lanes(-bound * turned));
            for (int64_t r = 0; r < rays; r++) rgb[(first + r) * 3 + a] = color[r];
        }
    }
}
}
