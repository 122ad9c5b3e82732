// Where rays cross planes. The reference, which says why, is geometry.plane_hits.
#include <algorithm>
#include <cmath>
#include <cstdint>

namespace {

struct Frame {
    float origin[3], axes[3][3], extent[4];
    float step, end, last; // disparity between planes and of the last one; number of the first one
};

struct Vector {
    float x, y, z;
};

Vector rotate(const Frame& frame, float x, float y, float z) {
    float to[3];
    for (int a = 0; a < 3; a++) to[a] = frame.axes[a][0] * x + frame.axes[a][1] * y + frame.axes[a][2] * z;
    return {to[0], to[1], to[2]};
}

// The half-spaces p w <= q in disparity in which a plane is live.
struct Conditions {
    float p[6], q[6], oz;

    bool live(float m, const Frame& frame) const {
        const float w = m * frame.step + frame.end;
        bool all = w * oz < 1 && m >= 0 && m <= frame.last;
        for (int i = 0; i < 6; i++) all &= p[i] * w <= q[i];
        return all;
    }

    // First and last plane of those that are live; none where low > high.
    void range(const Frame& frame, float& low, float& high) const {
        bool never = false;
        low = 0, high = frame.last;
        for (int i = 0; i < 6; i++) {
            const float slope = p[i] * frame.step, rest = q[i] - p[i] * frame.end;
            const float bound = rest / (slope == 0 ? 1 : slope);
            high = slope > 0 ? std::min(high, bound) : high;
            low = slope < 0 ? std::max(low, bound) : low;
            never |= slope == 0 && rest < 0;
        }
        high = never ? -1 : std::max(std::floor(high), -1.0f);
        low = never ? frame.last + 1 : std::min(std::ceil(low), frame.last + 1);
        // The division may be off by one plane at a border: the half-space test itself decides.
        high = live(high + 1, frame) ? high + 1 : live(high, frame) ? high : high - 1;
        low = live(low - 1, frame) ? low - 1 : live(low, frame) ? low : low + 1;
    }
};

} // namespace

extern "C" {

// Rays [begin, end) in all frames; what is written is geometry.PlaneHits.
void mmpi_plane_hits(const float* origins, const float* directions, const float* nears, const float* fars,
                     const Frame* frames, int64_t num_frames, float facing_eps, int64_t begin, int64_t end,
                     int64_t* first, int64_t* count, float* us, float* vs, float* local_origins,
                     float* local_directions) {
    for (int64_t i = begin * num_frames; i < end * num_frames; i++) {
        const int64_t ray = i / num_frames;
        const Frame& frame = frames[i % num_frames];
        const float *from = origins + 3 * ray, *to = directions + 3 * ray;
        const Vector o =
            rotate(frame, from[0] - frame.origin[0], from[1] - frame.origin[1], from[2] - frame.origin[2]);
        const Vector d = rotate(frame, to[0], to[1], to[2]);
        const bool facing = d.z > facing_eps;
        const float depth = facing ? d.z : 1, u = d.x / depth, v = d.y / depth;
        const float bend_u = o.x - o.z * u, bend_v = o.y - o.z * v, inverse_far = 1 / fars[ray];
        const float* e = frame.extent;
        const Conditions conditions{{d.z * nears[ray] + o.z, -(d.z + o.z * inverse_far), bend_u, -bend_u, bend_v, -bend_v},
                                    {1, -inverse_far, e[1] - u, u - e[0], e[3] - v, v - e[2]},
                                    o.z};
        float low, high;
        conditions.range(frame, low, high);
        first[i] = int64_t(high);
        count[i] = facing ? int64_t(std::max(high - low + 1, 0.0f)) : 0;
        us[2 * i] = u, us[2 * i + 1] = bend_u;
        vs[2 * i] = v, vs[2 * i + 1] = bend_v;
        local_origins[3 * i] = o.x, local_origins[3 * i + 1] = o.y, local_origins[3 * i + 2] = o.z;
        local_directions[3 * i] = d.x, local_directions[3 * i + 1] = d.y, local_directions[3 * i + 2] = d.z;
    }
}
}
