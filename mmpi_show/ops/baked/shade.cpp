// The network that shades a ray once (rendering/baked.py, Shader), sixteen rays at a time.
#include "layers.h"
#include "parts.h"

namespace {

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
