// Rendering weights of rays, with their gradients.
#include "lanes.h"
#include "parts.h"

#include <numeric>

namespace {

// e^-x, and 0 where that is no normal number: thousands of samples lie behind an opaque one.
inline Lanes passed(Lanes x) { return pick(x < 87.0f, exp_lanes(-x), Lanes{}); }

// Weights of the samples of rays [begin, end), and transmittance behind each of them; their sum and the optical depth of
// each ray.
void mmpi_composite(int64_t begin, int64_t end, const float* tau, const int64_t* starts, const float* skipped_before,
                    const float* skipped_total, float* weights, float* behind, float* mass, float* depth) {
    for (int64_t ray = begin; ray < end; ray++) {
        double before = 0;
        for (int64_t i = starts[ray]; i < starts[ray + 1]; i++) {
            behind[i] = float(before) + skipped_before[i]; // for now the depth in front of the sample
            before += tau[i];
        }
        depth[ray] = float(before) + skipped_total[ray];
    }
    for (int64_t i = starts[begin]; i < starts[end]; i += WIDTH) {
        const int64_t size = std::min<int64_t>(WIDTH, starts[end] - i);
        float own[WIDTH] = {}, before[WIDTH] = {};
        std::copy_n(tau + i, size, own), std::copy_n(behind + i, size, before);
        const Lanes thickness = load(own), in_front = load(before);
        store(own, passed(in_front) * absorbed(thickness)), store(before, passed(in_front + thickness));
        std::copy_n(own, size, weights + i), std::copy_n(before, size, behind + i);
    }
    for (int64_t ray = begin; ray < end; ray++)
        mass[ray] = float(std::accumulate(weights + starts[ray], weights + starts[ray + 1], 0.0));
}

// Gradient of the optical depths of the samples of rays [begin, end) from those of the weights and of the rays' sums.
void mmpi_composite_back(int64_t begin, int64_t end, const int64_t* starts, const float* weights, const float* behind,
                         const float* grad_weights, const float* grad_mass, const float* grad_depth, float* gradient) {
    for (int64_t ray = begin; ray < end; ray++) {
        double later = 0; // what the weights behind lose
        for (int64_t i = starts[ray + 1]; i-- > starts[ray];) {
            const double slope = double(grad_weights[i]) + grad_mass[ray];
            gradient[i] = float(slope * behind[i] - later + grad_depth[ray]);
            later += slope * weights[i];
        }
    }
}

} // namespace

IN_PARTS(mmpi_composite)
IN_PARTS(mmpi_composite_back)
