// Intersections of sixteen rays with the planes of all MPIs and the cube. The references, with their derivation, are
// geometry.plane_hits and geometry.cube_hits.
#pragma once
#include "lanes.h"
#include "scene.h"

#include <limits>
#include <vector>

namespace {

#include "ends.h"

struct Rays {
    const float *origins, *directions; // [R, 3] world
    const float *nears, *fars;         // [R, 1]
    const bool* heads;                 // [R, H] which may render a ray; null: all
    const float* priorities;           // [R, K]; the intersected MPI of highest priority renders; null: all
};

// Sixteen rays; those beyond the last one are its copies, and not `there`.
struct Packet {
    int64_t numbers[WIDTH];
    Lanes origin[3], direction[3], near, far;
    Mask there;

    Packet() = default;

    Packet(const Rays& rays, int64_t first, int64_t some) : there(IOTA < float(some)) {
        for (int64_t i = 0; i < WIDTH; i++) numbers[i] = first + std::min(i, some - 1);
        for (int a = 0; a < 3; a++) {
            origin[a] = each<Lanes>([&](int64_t ray) { return rays.origins[3 * ray + a]; });
            direction[a] = each<Lanes>([&](int64_t ray) { return rays.directions[3 * ray + a]; });
        }
        near = each<Lanes>([&](int64_t ray) { return rays.nears[ray]; });
        far = each<Lanes>([&](int64_t ray) { return rays.fars[ray]; });
    }

    // Sixteen times one of them, for samples along it: origins and directions.
    Packet repeated(int ray) const {
        Packet one;
        for (int a = 0; a < 3; a++) one.origin[a] = splat(origin[a][ray]), one.direction[a] = splat(direction[a][ray]);
        return one;
    }

    template <typename To, typename F> To each(F f) const {
        return each_lane<To>(truncated(IOTA), [&](int32_t i) { return f(numbers[i]); });
    }
};

inline Lanes floored(Lanes x) {
    const Lanes whole = real(truncated(x));
    return pick(whole > x, whole - 1.0f, whole);
}

// Rays in an MPI's axes.
struct LocalRays {
    Lanes origin[3], direction[3];

    LocalRays() = default;

    LocalRays repeated(int ray) const { // as Packet's
        LocalRays one;
        for (int a = 0; a < 3; a++) one.origin[a] = splat(origin[a][ray]), one.direction[a] = splat(direction[a][ray]);
        return one;
    }

    LocalRays(const Mpi& mpi, const Packet& rays) {
        for (int a = 0; a < 3; a++) {
            const float* axis = mpi.axes[a];
            origin[a] = axis[0] * (rays.origin[0] - mpi.origin[0]) + axis[1] * (rays.origin[1] - mpi.origin[1]) +
                        axis[2] * (rays.origin[2] - mpi.origin[2]);
            const int i = a < 2; // fixes which product is rounded, and so the bits of results
            direction[a] = axis[i] * rays.direction[i] + axis[1 - i] * rays.direction[1 - i] + axis[2] * rays.direction[2];
        }
    }
};

// The intersected planes of one MPI: `count` of them from `first` on, counted from the last plane of the MPI.
struct Crossing : LocalRays {
    IntLanes first, count;
    Lanes u, u_slope, v, v_slope; // tangents on the plane of disparity w: u + w u_slope

    Crossing() = default;

    Crossing(const Mpi& mpi, const Packet& rays) : LocalRays(mpi, rays) {
        const Lanes oz = origin[2], dz = direction[2];
        const Mask facing = dz > FACING;
        const Lanes depth = pick(facing, dz, splat(1)), inverse_far = 1.0f / rays.far;
        u = direction[0] / depth, v = direction[1] / depth;
        u_slope = origin[0] - oz * u, v_slope = origin[1] - oz * v;
        // Half-spaces p w <= q in disparity in which a plane is intersected.
        const float* e = mpi.extent;
        const Lanes p[6] = {dz * rays.near + oz, -(dz + oz * inverse_far), u_slope, -u_slope, v_slope, -v_slope};
        const Lanes q[6] = {splat(1), -inverse_far, e[1] - u, u - e[0], e[3] - v, v - e[2]};
        Mask never{};
        Lanes low{}, high = splat(mpi.last);
        for (int i = 0; i < 6; i++) {
            const Lanes slope = p[i] * mpi.step, rest = q[i] - p[i] * mpi.end;
            const Lanes bound = rest / pick(slope == 0, splat(1), slope);
            high = pick(slope > 0, least(bound, high), high);
            low = pick(slope < 0, most(bound, low), low);
            never |= ((slope == 0) & (rest < 0)) | (bound != bound); // NaN: a ray from nowhere
        }
        high = pick(never, splat(-1), floored(most(high, splat(-1))));
        low = pick(never, splat(mpi.last + 1), -floored(-least(low, splat(mpi.last + 1))));
        const auto intersected = [&](Lanes m) {
            const Lanes w = m * mpi.step + mpi.end;
            Mask all = (w * oz < 1) & (m >= 0) & (m <= mpi.last);
            for (int i = 0; i < 6; i++) all &= p[i] * w <= q[i];
            return all;
        };
        // The division may be off by one plane at a border, so the half-space test decides.
        high = pick(intersected(high + 1), high + 1, pick(intersected(high), high, high - 1));
        low = pick(intersected(low - 1), low - 1, pick(intersected(low), low, low + 1));
        first = truncated(high);
        count = facing & truncated(most(high - low + 1, Lanes{}));
    }
};

// The samples of the cube on rays: `count` of them from number `first` on, at distances (number + 1/2) step.
struct CubeCrossing {
    IntLanes first{}, count{};

    CubeCrossing() = default;

    CubeCrossing(const Cube& cube, const Packet& rays) {
        const Lanes endless = splat(std::numeric_limits<float>::infinity());
        Lanes enter = -endless, leave = endless;
        float diagonal = 0;
        for (int a = 0; a < 3; a++) {
            const Lanes o = rays.origin[a], d = rays.direction[a], safe = pick(d == 0, splat(1), d);
            const Lanes to_lower = (cube.lower[a] - o) / safe, to_upper = (cube.upper[a] - o) / safe;
            const Mask inside = (o >= cube.lower[a]) & (o <= cube.upper[a]);
            const Lanes in = pick(d == 0, pick(inside, -endless, endless), least(to_lower, to_upper));
            const Lanes out = pick(d == 0, pick(inside, endless, -endless), most(to_lower, to_upper));
            enter = most(enter, in), leave = least(leave, out);
            diagonal += cube.extent[a] * cube.extent[a];
        }
        enter = most(enter, rays.near), leave = least(leave, rays.far);
        const float longest = 2 * std::sqrt(diagonal) / cube.step;
        const Lanes from = enter / cube.step - 0.5f, to = leave / cube.step - 0.5f;
        const Mask hit = (enter <= leave) & (magnitude(from) < 1e9f) & (to - from <= longest);
        const Lanes lowest = -floored(-pick(hit, from, Lanes{}));
        first = hit & truncated(lowest);
        count = hit & truncated(most(floored(pick(hit, to, Lanes{})) - lowest + 1, Lanes{}));
    }
};

// The samples of sixteen rays in the allowed heads.
struct Crossings {
    std::vector<Crossing> mpis;
    CubeCrossing cube;
    IntLanes total;     // of all heads
    Mask fully_covered; // from before the first content out to infinity, or by any head where all are allowed

    void cross(const Scene& scene, const Rays& rays, const Packet& packet) {
        const int64_t K = scene.num_mpis, H = scene.num_heads;
        mpis.resize(K);
        for (int64_t k = 0; k < K; k++) mpis[k] = Crossing(scene.mpis[k], packet);
        cube = H > K ? CubeCrossing(*scene.cube, packet) : CubeCrossing();
        if (rays.priorities) choose(rays.priorities, packet);
        for (int64_t h = 0; h < H && rays.heads; h++)
            count(h) &= packet.each<IntLanes>([&](int64_t ray) { return -int32_t(rays.heads[ray * H + h]); });
        total = cube.count;
        for (const Crossing& mpi : mpis) total += mpi.count;
        fully_covered = total > 0;
        if (rays.priorities || rays.heads) fully_covered &= sees_all(scene);
    }

    IntLanes& count(int64_t head) { return head < int64_t(mpis.size()) ? mpis[head].count : cube.count; }

  private:
    void choose(const float* priorities, const Packet& packet) {
        const int64_t K = mpis.size();
        Lanes highest = splat(-1);
        IntLanes best{};
        for (int64_t k = 0; k < K; k++) {
            const Lanes priority = packet.each<Lanes>([&](int64_t ray) { return priorities[ray * K + k]; });
            const Mask better = (mpis[k].count > 0) & (priority > highest);
            highest = pick(better, priority, highest), best = pick(better, whole(int32_t(k)), best);
        }
        for (int64_t k = 0; k < K; k++) mpis[k].count &= best == int32_t(k);
    }

    // Whether an MPI reaches to infinity, and the first one is entered before the first content.
    Mask sees_all(const Scene& scene) const {
        Mask entered{}, endless{};
        for (size_t k = 0; k < mpis.size(); k++) {
            const Mpi& mpi = scene.mpis[k];
            const Mask intersected = mpis[k].count > 0;
            // One plane before the first intersected one bounds the entry; behind the camera: the ray starts inside.
            const Lanes w = least(real(mpis[k].first + 1), splat(mpi.last)) * mpi.step + mpi.end;
            const Lanes bent = w * mpis[k].origin[2];
            entered |= intersected & ((bent >= 1) | (w * mpis[k].direction[2] / (1 - bent) * scene.content_near >= 1));
            if (mpi.end == 0) endless |= intersected & (mpis[k].first - mpis[k].count < 0);
        }
        return entered & endless;
    }
};

} // namespace
