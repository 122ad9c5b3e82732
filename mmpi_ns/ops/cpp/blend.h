// Optical depth of a sample after blending by reliability (blending.find_votes, blend_shares, blended_optical_depth).
#pragma once
#include "crossings.h"
#include "taps.h"

namespace {

// Position of a sample in the cube.
inline void place_in_cube(const Cube& cube, const Packet& rays, int ray, float t, float* ndc) {
    for (int a = 0; a < 3; a++) {
        const float x = rays.origin[a][ray] + rays.direction[a][ray] * t;
        ndc[a] = 2 * (x - cube.lower[a]) / cube.extent[a] - 1;
    }
}

// Position of a sample of a ray, which is `local` in the MPIs' axes, in head j; false outside its frustum.
template <typename Local>
bool place(const Scene& scene, const Packet& rays, const std::vector<Local>& local, int ray, int64_t j, float inverse_t,
           float* ndc) {
    if (j < scene.num_mpis) {
        const Mpi& mpi = scene.mpis[j];
        const Lanes *o = local[j].origin, *d = local[j].direction;
        const float z = o[2][ray] * inverse_t + d[2][ray];
        if (!(z > 0)) {
            ndc[0] = ndc[1] = ndc[2] = 0;
            return false;
        }
        ndc[0] = ((o[0][ray] * inverse_t + d[0][ray]) / z - mpi.u0) * mpi.u_scale - 1;
        ndc[1] = ((o[1][ray] * inverse_t + d[1][ray]) / z - mpi.v0) * mpi.v_scale - 1;
        ndc[2] = 1 - (mpi.s_scale * inverse_t / z - mpi.s_scale * mpi.end);
        const float slack = 16 * std::numeric_limits<float>::epsilon(), s_slack = slack / mpi.share;
        return std::abs(ndc[0]) <= 1 + slack && std::abs(ndc[1]) <= 1 + slack && std::abs(ndc[2]) <= 1 + s_slack;
    }
    place_in_cube(*scene.cube, rays, ray, 1 / std::max(inverse_t, NEAREST_ZERO), ndc);
    bool inside = inverse_t > 0;
    for (int a = 0; a < 3; a++) {
        inside = inside && std::abs(ndc[a]) <= 1;
        ndc[a] = std::min(std::max(ndc[a], -1.0f), 1.0f);
    }
    return inside;
}

// -log(1 - x) for 0 <= x <= 1/2, to a few ulp: 2 atanh(x / (2 - x)).
inline float minus_log_rest(float x) {
    const float z = x / (2 - x), q = z * z; // q <= 1/9
    float p = 1.0f / 15;
    for (int n = 13; n > 0; n -= 2) p = p * q + 1.0f / n;
    return 2 * z * p;
}

// The texels whose reliabilities are the votes on a sample, of each head in whose frustum it lies. They are looked up, and
// prefetched, some time before they are read: heads have millions of texels, and neighbouring samples other ones.
struct Votes {
    struct Vote {
        Sample texels;
        int64_t head, nearest; // the nearest texel, which must be trained to vote; -1 of the sample's head, which votes
        float value;
    };
    std::vector<Vote> votes;

    template <typename Local>
    void look_up(const Scene& scene, const Packet& rays, const std::vector<Local>& local, int ray, int64_t own,
                 float inverse_t) {
        votes.clear();
        for (int64_t j = 0; j < scene.num_heads; j++) {
            float ndc[3];
            if (!place(scene, rays, local, ray, j, inverse_t, ndc) && j != own) continue;
            Vote& vote = votes.emplace_back();
            vote.head = j, vote.nearest = j == own ? -1 : nearest_texel(scene.grids[j], ndc);
            vote.texels.put(scene.grids[j], true, 0, ndc);
            __builtin_prefetch(scene.touched + vote.nearest);
            for (int tap = 0; tap < vote.texels.taps; tap++) __builtin_prefetch(scene.reliability + vote.texels.rows[tap]);
        }
    }

    static bool counts(const Scene& scene, const Vote& vote) { return vote.nearest < 0 || scene.touched[vote.nearest]; }

    // The sample's optical depth after blending.
    float blended(const Scene& scene, float tau) {
        float vote_of_head = 0, highest = -std::numeric_limits<float>::infinity(), others = 0;
        size_t count = 0;
        for (size_t i = 0; i < votes.size(); i++) {
            if (!counts(scene, votes[i])) continue;
            float value = 0;
            const Sample& texels = votes[i].texels;
            for (int tap = 0; tap < texels.taps; tap++) value += texels.shares[tap] * scene.reliability[texels.rows[tap]];
            if (votes[i].nearest < 0)
                vote_of_head = value;
            else
                votes[count++].value = value, highest = std::max(highest, value);
        }
        if (!count) return tau; // the sole cover
        for (size_t i = 0; i < count; i++) others += std::exp(votes[i].value - highest);
        // With the others' share over its own, w: P = 1 / (1 + w), and 1 - alpha' = (w + e^-tau) / (1 + w).
        const float ratio = others * std::exp(highest - vote_of_head), alpha = -std::expm1(-tau) / (1 + ratio);
        if (alpha < 0.5f) return minus_log_rest(alpha);
        return std::log((1 + ratio) / std::max(ratio + std::exp(-tau), std::numeric_limits<float>::min()));
    }
};

} // namespace
