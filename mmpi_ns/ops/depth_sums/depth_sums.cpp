// Spread and mass of the weights of rays, with their gradients.
#include "parts.h"

#include <cmath>

namespace {

constexpr float REACH = 3; // widths, as in __init__.py
constexpr float FADES = 120; // squared widths, beyond which the window is 0 to float32

float position(float inverse_t, float scale) { return 1 / (1 + scale * inverse_t); }

float window(float scaled) { return scaled * scaled < FADES ? std::exp(-0.5f * scaled * scaled) : 0; }

// Rays [begin, end): spread, mass, and whether a sample is near the target.
void mmpi_depth_sums(int64_t begin, int64_t end, int64_t slots, float scale, const bool* valid, const float* weights,
                     const float* inverse_t, const float* intervals, const float* targets, float* spread, float* mass,
                     bool* reached) {
    for (int64_t r = begin; r < end; r++) {
        const float target = targets[2 * r], width = targets[2 * r + 1];
        // In double: differences of sums that agree in most digits where a ray ends in one surface.
        double before = 0, moment = 0, between = 0, squares = 0;
        float gathered = 0;
        bool near = false;
        for (int64_t i = r * slots; i < (r + 1) * slots; i++) {
            if (!valid[i]) continue;
            const double w = weights[i], s = position(inverse_t[i], scale);
            between += w * (s * before - moment);
            squares += w * w;
            before += w;
            moment += w * s;
            const float scaled = (inverse_t[i] - target) / width;
            gathered += weights[i] * window(scaled);
            near |= std::abs(scaled) < REACH;
        }
        spread[r] = float(2 * between + squares * intervals[r] / 3);
        mass[r] = gathered;
        reached[r] = near && target > 0;
    }
}

// Gradient of the weights from those of spread and mass.
void mmpi_depth_sums_back(int64_t begin, int64_t end, int64_t slots, float scale, const bool* valid,
                          const float* weights, const float* inverse_t, const float* intervals, const float* targets,
                          const float* grad_spread, const float* grad_mass, float* gradient) {
    for (int64_t r = begin; r < end; r++) {
        const float target = targets[2 * r], width = targets[2 * r + 1];
        double before = 0, moment = 0, all = 0, moments = 0;
        for (int64_t i = r * slots; i < (r + 1) * slots; i++) {
            if (!valid[i]) continue;
            all += weights[i];
            moments += double(weights[i]) * position(inverse_t[i], scale);
        }
        for (int64_t i = r * slots; i < (r + 1) * slots; i++) {
            gradient[i] = 0;
            if (!valid[i]) continue;
            const double w = weights[i], s = position(inverse_t[i], scale);
            const double behind = all - before - w, moment_behind = moments - moment - w * s;
            const double slope = 2 * (s * before - moment + moment_behind - s * behind + w * intervals[r] / 3);
            gradient[i] = float(grad_spread[r] * slope);
            if (grad_mass[r] != 0) gradient[i] += grad_mass[r] * window((inverse_t[i] - target) / width);
            before += w;
            moment += w * s;
        }
    }
}

} // namespace

IN_PARTS(mmpi_depth_sums)
IN_PARTS(mmpi_depth_sums_back)
