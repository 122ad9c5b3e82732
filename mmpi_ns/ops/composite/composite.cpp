// Rendering weights of rays with their gradients.
#include "lanes.h"
#include "parts.h"

#include <algorithm>
#include <vector>

namespace {

// 1 - e^-x for x >= 0, exact also where it is small.
Lanes absorbed(Lanes x) {
    Lanes p = splat(1.0f / 40320);
    p = p * x - 1.0f / 5040;
    p = p * x + 1.0f / 720;
    p = p * x - 1.0f / 120;
    p = p * x + 1.0f / 24;
    p = p * x - 1.0f / 6;
    p = p * x + 0.5f;
    const Lanes thin = x - x * x * p, thick = 1.0f - exp_lanes(-x);
    return x > 0.25f ? thick : thin;
}

// Optical depths of one ray, padded with zeros to whole lanes, and the depth in front of each sample. Empty slots at
// the end of a ray are skipped.
struct Ray {
    int64_t size = 0;
    std::vector<float> tau, before;

    explicit Ray(int64_t slots) : tau(slots + WIDTH), before(slots + WIDTH) {}

    // Returns the total optical depth.
    float take(const float* taus, const bool* valid, const float* skipped, int64_t slots) {
        for (size = slots; size > 0 && !valid[size - 1];) size--;
        std::fill(tau.begin() + size, tau.end(), 0.0f);
        double depth = 0; // as torch sums
        for (int64_t s = 0; s < size; s++) {
            tau[s] = valid[s] ? taus[s] : 0;
            before[s] = float(depth) + skipped[s];
            depth += tau[s];
        }
        return float(depth);
    }
};

// Rays [begin, end): weights [R, S], and e^-depth of the whole ray [R].
void mmpi_composite(int64_t begin, int64_t end, int64_t slots, const float* tau, const bool* valid,
                    const float* skipped_before, const float* skipped_total, float* weights, float* depth) {
    Ray ray(slots);
    for (int64_t r = begin; r < end; r++) {
        const int64_t first = r * slots;
        depth[r] = ray.take(tau + first, valid + first, skipped_before + first, slots) + skipped_total[r];
        for (int64_t s = 0; s < ray.size; s += WIDTH) {
            const Lanes weight = exp_lanes(-load(&ray.before[s])) * absorbed(load(&ray.tau[s]));
            store(&ray.tau[s], weight);
        }
        for (int64_t s = 0; s < ray.size; s++) weights[first + s] = valid[first + s] ? ray.tau[s] : 0;
        std::fill(weights + first + ray.size, weights + first + slots, 0.0f);
    }
}

// Gradient of the optical depths from that of the weights and of the whole depth.
void mmpi_composite_back(int64_t begin, int64_t end, int64_t slots, const float* tau, const bool* valid,
                         const float* skipped_before, const float* weights, const float* grad_weights,
                         const float* grad_depth, float* grad) {
    Ray ray(slots);
    for (int64_t r = begin; r < end; r++) {
        const int64_t first = r * slots;
        ray.take(tau + first, valid + first, skipped_before + first, slots);
        for (int64_t s = 0; s < ray.size; s += WIDTH)
            store(&ray.before[s], exp_lanes(-load(&ray.before[s]) - load(&ray.tau[s])));
        float behind = 0; // what the weights of later samples lose
        std::fill(grad + first + ray.size, grad + first + slots, 0.0f);
        for (int64_t s = ray.size; s-- > 0;) {
            const int64_t i = first + s;
            grad[i] = valid[i] ? grad_weights[i] * ray.before[s] - behind + grad_depth[r] : 0;
            if (valid[i]) behind += grad_weights[i] * weights[i];
        }
    }
}

} // namespace

IN_PARTS(mmpi_composite)
IN_PARTS(mmpi_composite_back)
