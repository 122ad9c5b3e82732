// Rays through all heads of a scene, and what reliability makes of their samples.
#pragma once
#include "scene.h"

#include <limits>
#include <vector>

namespace {

constexpr float OPAQUE = 1e-5f;      // light that may be lost behind the end of a ray
constexpr float NEGLIGIBLE = 1e-4f;  // optical depths below this get an equal share without a lookup
constexpr float INFINITY_T = 1e-10f; // inverse distances are no less where a distance is needed

struct Rays {
    const float *origins, *directions;             // [R, 3] world
    const float *local_origins, *local_directions; // [R, K, 3]
    const float *u, *v;                            // [R, K, 2]
    const int64_t* first;                          // [R, H]: m of the nearest plane; the cube's first sample
    const int64_t* counts;                         // [R, H]
};

// Which samples of a ray are kept, and where it ends.
struct Bounds {
    float weight, light; // a sample weighs more; no less light is left

    Bounds(float threshold, float fair_share, int64_t samples)
        : weight(threshold > 0 ? std::min(fair_share / float(std::max<int64_t>(samples, 1)), threshold) : -1),
          light(threshold > 0 ? std::min(weight, OPAQUE) : -1) {}
};

// Where a sample of the cube lies.
inline void place_in_cube(const Cube& cube, const Rays& rays, int64_t ray, float t, float* ndc) {
    for (int a = 0; a < 3; a++) {
        const float x = rays.origins[3 * ray + a] + rays.directions[3 * ray + a] * t;
        ndc[a] = 2 * (x - cube.lower[a]) / cube.extent[a] - 1;
    }
}

// Where a sample lies in head j; false outside its frustum.
inline bool place(const Scene& scene, const Rays& rays, int64_t ray, int64_t j, float inverse_t, float* ndc) {
    if (j < scene.num_mpis) {
        const Mpi& mpi = scene.mpis[j];
        const float *o = rays.local_origins + 3 * (ray * scene.num_mpis + j),
                    *d = rays.local_directions + 3 * (ray * scene.num_mpis + j);
        const float z = o[2] * inverse_t + d[2];
        if (!(z > 0)) {
            ndc[0] = ndc[1] = ndc[2] = 0;
            return false;
        }
        ndc[0] = ((o[0] * inverse_t + d[0]) / z - mpi.u0) * mpi.u_scale - 1;
        ndc[1] = ((o[1] * inverse_t + d[1]) / z - mpi.v0) * mpi.v_scale - 1;
        ndc[2] = 1 - (mpi.s_scale * inverse_t / z - mpi.s_scale * mpi.end);
        const float slack = 16 * std::numeric_limits<float>::epsilon(), s_slack = slack / mpi.share;
        return std::abs(ndc[0]) <= 1 + slack && std::abs(ndc[1]) <= 1 + slack && std::abs(ndc[2]) <= 1 + s_slack;
    }
    place_in_cube(*scene.cube, rays, ray, 1 / std::max(inverse_t, INFINITY_T), ndc);
    bool inside = inverse_t > 0;
    for (int a = 0; a < 3; a++) {
        inside = inside && std::abs(ndc[a]) <= 1;
        ndc[a] = std::min(std::max(ndc[a], -1.0f), 1.0f);
    }
    return inside;
}

inline float softplus(float x) { return x > 20 ? x : std::log1p(std::exp(x)); }

// Optical depth of a sample after blending (blending.blend_shares and blended_optical_depth).
inline float blended(const Scene& scene, const Rays& rays, int64_t ray, int64_t own, float inverse_t, float tau,
                     std::vector<float>& votes) {
    if (tau <= NEGLIGIBLE) return tau / float(scene.num_heads);
    float ndc[3], own_vote = 0, highest = -std::numeric_limits<float>::infinity(), others = 0;
    votes.clear();
    for (int64_t j = 0; j < scene.num_heads; j++) {
        if (!place(scene, rays, ray, j, inverse_t, ndc) && j != own) continue;
        const Grid& grid = scene.grids[j];
        if (j == own) {
            own_vote = trilinear(scene.reliability, grid, ndc);
        } else if (scene.touched[nearest_texel(grid, ndc)]) {
            votes.push_back(trilinear(scene.reliability, grid, ndc));
            highest = std::max(highest, votes.back());
        }
    }
    if (votes.empty()) return tau; // the sole cover
    for (float vote : votes) others += std::exp(vote - highest);
    const float odds = highest - own_vote + std::log(others);
    const float log_share = -softplus(odds), log_rest = -softplus(-odds);
    const float alpha = -std::expm1(-tau) * std::exp(log_share);
    if (alpha < 0.5f) return -std::log1p(-alpha);
    const float a = log_rest, b = log_share - tau;
    return std::max(-(std::max(a, b) + softplus(-std::abs(a - b))), 0.0f);
}

} // namespace
