// Spread and mass of the weights of rays, with their gradients.
#include "lanes.h"
#include "parts.h"

namespace {

// Spread and mass of rays [begin, end), whether a sample is near the target, and the gradients of both by the weights.
void mmpi_depth_sums(int64_t begin, int64_t end, const float* weights, const float* inverse_t, const int64_t* starts,
                     const float* intervals, const float* targets, float scale, float reach, float* spread, float* mass,
                     bool* reached, float* slope, float* window) {
    for (int64_t ray = begin; ray < end; ray++) {
        const float target = targets[2 * ray], width = targets[2 * ray + 1];
        // In double: differences of sums that agree in most digits where a ray ends in one surface.
        double all = 0, moments = 0, passed = 0, moment = 0, product = 0;
        bool near = false;
        for (int64_t i = starts[ray]; i < starts[ray + 1]; i++) {
            const float away = (inverse_t[i] - target) / width;
            window[i] = away * away, slope[i] = 1 / (1 + scale * inverse_t[i]); // for now squared widths, and s
            near |= window[i] < reach;
            all += weights[i], moments += double(weights[i]) * slope[i];
        }
        for (int64_t i = starts[ray]; i < starts[ray + 1]; i++) {
            const double weight = weights[i], s = slope[i];
            passed += weight, moment += weight * s;
            const double pairs = (2 * passed - all) * s + moments - 2 * moment;
            slope[i] = float(2 * pairs + 2.0 / 3 * weight * intervals[ray]);
            product += weight * slope[i];
        }
        spread[ray] = float(product / 2), reached[ray] = near && target > 0;
    }
    for (int64_t i = starts[begin]; i < starts[end]; i += WIDTH) {
        const int64_t size = std::min<int64_t>(WIDTH, starts[end] - i);
        float away[WIDTH] = {};
        std::copy_n(window + i, size, away);
        store(away, exp_lanes(-0.5f * load(away)));
        std::copy_n(away, size, window + i);
    }
    for (int64_t ray = begin; ray < end; ray++) {
        float sum = 0;
        for (int64_t i = starts[ray]; i < starts[ray + 1]; i++) sum += weights[i] * window[i];
        mass[ray] = sum;
    }
}

// Gradient of the weights of rays [begin, end) from those of spread and mass.
void mmpi_depth_sums_back(int64_t begin, int64_t end, const int64_t* starts, const float* slope, const float* window,
                          const float* grad_spread, const float* grad_mass, float* gradient) {
    for (int64_t ray = begin; ray < end; ray++)
        for (int64_t i = starts[ray]; i < starts[ray + 1]; i++)
            gradient[i] = grad_spread[ray] * slope[i] + grad_mass[ray] * window[i];
}

} // namespace

IN_PARTS(mmpi_depth_sums)
IN_PARTS(mmpi_depth_sums_back)
