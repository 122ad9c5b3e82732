// Optical depths of sixteen samples after blending by reliability (blending.find_votes, blend_shares,
// blended_optical_depth).
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

// Positions along an axis of `size` texels, from coordinates in [-1, 1]; outside they are clamped to the border.
inline Lanes on_axis(Lanes coordinate, int64_t size) {
    const float last = float(size - 1);
    return least(most((coordinate + 1.0f) * (0.5f * last), Lanes{}), splat(last));
}

// Lower texels and fractions (as Cell).
inline void cells(Lanes coordinate, int64_t size, IntLanes& lower, Lanes& fraction) {
    const Lanes position = on_axis(coordinate, size);
    lower = least(truncated(position), whole(int32_t(size - 2))); // positions are not negative
    fraction = position - real(lower);
}

// Positions of sixteen samples in one head.
struct Places {
    Lanes ndc[3];
    Mask inside; // its frustum

    // On rays, which are `local` in the axes of head j.
    Places(const Scene& scene, const Packet& rays, const LocalRays* local, int64_t j, Lanes inverse_t) {
        if (j == scene.num_mpis)
            in_cube(*scene.cube, rays, inverse_t);
        else
            in_mpi(scene.mpis[j], *local, inverse_t);
    }

  private:
    void in_mpi(const Mpi& mpi, const LocalRays& local, Lanes inverse_t) {
        const Lanes *o = local.origin, *d = local.direction, z = o[2] * inverse_t + d[2];
        const float slack = 16 * std::numeric_limits<float>::epsilon(), s_slack = slack / mpi.share;
        ndc[0] = ((o[0] * inverse_t + d[0]) / z - mpi.u0) * mpi.u_scale - 1.0f;
        ndc[1] = ((o[1] * inverse_t + d[1]) / z - mpi.v0) * mpi.v_scale - 1.0f;
        ndc[2] = 1.0f - (mpi.s_scale * inverse_t / z - mpi.s_scale * mpi.end);
        for (Lanes& coordinate : ndc) coordinate = pick(z > 0.0f, coordinate, Lanes{});
        inside = (z > 0.0f) & (magnitude(ndc[0]) <= 1 + slack) & (magnitude(ndc[1]) <= 1 + slack) &
                 (magnitude(ndc[2]) <= 1 + s_slack);
    }

    void in_cube(const Cube& cube, const Packet& rays, Lanes inverse_t) {
        const Lanes t = 1.0f / most(inverse_t, splat(NEAREST_ZERO));
        inside = inverse_t > 0.0f;
        for (int a = 0; a < 3; a++) {
            ndc[a] = 2.0f * (rays.origin[a] + rays.direction[a] * t - cube.lower[a]) / cube.extent[a] - 1.0f;
            inside &= magnitude(ndc[a]) <= 1.0f;
        }
    }
};

// Votes of one head on sixteen samples: the texels whose reliability is the vote. Heads have millions of texels, and
// neighbouring samples other ones, so each step prefetches what the next one reads: take the steps head by head.
class Votes {
  public:
    // `own`: samples of this head, which always votes on them; others need a nearest texel that was trained.
    void place(const Grid& grid, const Places& places, Mask own, Mask asked) {
        this->grid = &grid, this->own = bits(own & asked), lanes = bits((own | places.inside) & asked);
        const Lanes half = splat(12582912.0f); // 1.5 * 2^23: adding it rounds to an integer
        const int64_t sizes[3] = {grid.width, grid.height, grid.depth};
        IntLanes nearest{};
        for (int a = 0; a < 3; a++) {
            IntLanes texels;
            Lanes fractions;
            cells(places.ndc[a], sizes[a], texels, fractions);
            store(lower[a], texels), store(fraction[a], fractions);
            nearest += (truncated((on_axis(places.ndc[a], sizes[a]) + half) - half) - texels) << a;
        }
        store(this->nearest, nearest);
        for (uint32_t left = lanes; left; left &= left - 1) {
            const int i = __builtin_ctz(left);
            for (const int behind : {0, 1}) __builtin_prefetch(grid.tile(lower[2][i] + behind, lower[1][i], lower[0][i]));
        }
    }

    void look_up(const Scene& scene) {
        for (uint32_t left = lanes; left; left &= left - 1) {
            const int i = __builtin_ctz(left);
            texels[i].taps = 0;
            texels[i].put(*grid, {lower[2][i], fraction[2][i]}, {lower[1][i], fraction[1][i]},
                          {lower[0][i], fraction[0][i]});
            __builtin_prefetch(scene.touched + texels[i].rows[nearest[i]]);
            for (const int tap : {0, 2, 4, 6}) __builtin_prefetch(scene.reliability + texels[i].rows[tap]);
        }
    }

    // Calls f with the number and the texels of every sample that has a vote.
    template <typename F> void each(const Scene& scene, F f) const {
        for (uint32_t left = lanes; left; left &= left - 1) {
            const int i = __builtin_ctz(left);
            if (own >> i & 1 || scene.touched[texels[i].rows[nearest[i]]]) f(i, texels[i]);
        }
    }

  private:
    const Grid* grid = nullptr;
    uint32_t own = 0, lanes = 0; // a bit for each sample
    int32_t lower[3][WIDTH], nearest[WIDTH]; // the nearest one of the eight texels
    float fraction[3][WIDTH];
    Sample texels[WIDTH];
};

// -log(1 - x) for 0 <= x <= 1/2, to a few ulp: 2 atanh(x / (2 - x)).
inline Lanes minus_log_rest(Lanes x) {
    const Lanes z = x / (2.0f - x), q = z * z; // q <= 1/9
    Lanes p = splat(1.0f / 15);
    for (int n = 13; n > 0; n -= 2) p = p * q + 1.0f / n;
    return 2.0f * z * p;
}

// Shares of heads by their votes.
class Blending {
  public:
    explicit Blending(const Scene& scene) : scene(scene), values(scene.num_heads), votes(scene.num_heads) {}

    // Optical depths after blending of samples of head `own`; local(j) are their rays in the axes of MPI j.
    template <typename Local>
    Lanes blended(const Packet& rays, const Local& local, int64_t own, Lanes inverse_t, Lanes tau, Mask going) {
        const Mask asked = going & (tau > NEGLIGIBLE);
        if (!any(asked)) return tau / float(scene.num_heads);
        count(rays, local, own, inverse_t, asked);
        const Lanes own_vote = values[own], lowest = splat(LOWEST);
        values[own] = lowest;
        Lanes highest = lowest, others{};
        for (const Lanes& value : values) highest = most(highest, value);
        const Mask shared = asked & (highest > lowest); // the others are the sole cover
        for (const Lanes& value : values) others += pick(value > lowest, exp_lanes(value - highest), Lanes{});
        // With the others' share over its own, w: P = 1 / (1 + w), and 1 - alpha' = (w + e^-tau) / (1 + w).
        const Lanes ratio = others * exp_lanes(highest - own_vote), alpha = absorbed(tau) / (1.0f + ratio);
        Lanes depth = minus_log_rest(alpha);
        for (uint32_t left = bits(shared & (alpha >= 0.5f)); left; left &= left - 1) {
            const int i = __builtin_ctz(left);
            const float rest = std::max(ratio[i] + std::exp(-tau[i]), std::numeric_limits<float>::min());
            depth[i] = std::log((1 + ratio[i]) / rest);
        }
        return pick(asked, pick(shared, depth, tau), tau / float(scene.num_heads));
    }

  private:
    static constexpr float LOWEST = -std::numeric_limits<float>::infinity();
    const Scene& scene;
    std::vector<Lanes> values; // of each head's vote; the lowest where it has none
    std::vector<Votes> votes;

    template <typename Local>
    void count(const Packet& rays, const Local& local, int64_t own, Lanes inverse_t, Mask asked) {
        for (int64_t j = 0; j < scene.num_heads; j++) {
            const LocalRays* axes = j < scene.num_mpis ? &local(j) : nullptr;
            votes[j].place(scene.grids[j], Places(scene, rays, axes, j, inverse_t), whole(-(j == own)), asked);
        }
        for (Votes& vote : votes) vote.look_up(scene);
        for (int64_t j = 0; j < scene.num_heads; j++) {
            values[j] = splat(LOWEST);
            votes[j].each(scene, [&](int i, const Sample& texels) {
                float sum = 0;
                for (int tap = 0; tap < texels.taps; tap++) sum += texels.shares[tap] * scene.reliability[texels.rows[tap]];
                values[j][i] = sum;
            });
        }
    }
};

} // namespace
