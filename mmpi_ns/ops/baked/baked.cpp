// Rays through baked multi-plane images (scene/baked.py), sixteen at once: all MPIs by distance, from brick to brick,
// until a ray is opaque. What each gathers is read afterwards, all channels of a texel at once. The reference is
// reference.py.
#include "walks.h"

#include <algorithm>
#include <vector>

namespace {

constexpr float OPAQUE = 1e-2f; // a ray that lets less through is over
constexpr int FINENESS = 8, COLORS = 3, CELLS = 7;
constexpr int32_t CORNERS[4] = {0, 1, 8, 9}; // of a cell, texels within a brick
typedef uint8_t ByteLanes __attribute__((vector_size(16)));
typedef uint16_t ShortLanes __attribute__((vector_size(32)));

struct Head {
    float origin[3], axes[3][3];
    float u0, v0, u1, v1, u_scale, v_scale; // texel = (u - u0) * u_scale
    Stack stack;
    const float* pass; // e^-tau at codes 0, 1/8, ...
};

struct Scene {
    int64_t num_heads, channels;
    const Head* heads;
    const Column* columns;
    const uint8_t *density, *texels; // with some bytes behind each, which are read and not used
    const float *low, *step;         // of sixteen channels; features' doubled, for tanh x = 2 sigmoid(2 x) - 1
};

struct Packet {
    Lanes origin[3], direction[3], near, inverse_far;
};

// Rays on their way through one head, at the first plane that each can meet.
Walks<CELLS> begin(const Scene& scene, const Head& head, const Packet& rays) {
    const Stack& stack = head.stack;
    Lanes o[3], d[3], relative[3];
    for (int a = 0; a < 3; a++) relative[a] = rays.origin[a] - head.origin[a];
    for (int a = 0; a < 3; a++) {
        const float* axis = head.axes[a];
        o[a] = axis[0] * relative[0] + axis[1] * relative[1] + axis[2] * relative[2];
        d[a] = axis[0] * rays.direction[0] + axis[1] * rays.direction[1] + axis[2] * rays.direction[2];
    }
    const Lanes u = d[0] / d[2], v = d[1] / d[2], bend_u = o[0] - o[2] * u, bend_v = o[1] - o[2] * v;
    // Half-spaces p w <= q in disparity, as in scene/geometry.py.
    const Lanes p[6] = {d[2] * rays.near + o[2], -(d[2] + o[2] * rays.inverse_far), bend_u, -bend_u, bend_v, -bend_v};
    const Lanes q[6] = {splat(1), -rays.inverse_far, head.u1 - u, u - head.u0, head.v1 - v, v - head.v0};
    Mask meets = d[2] > 1e-6f;
    Lanes low{}, high = splat(float(stack.planes - 1)); // planes counted from the last one
    for (int i = 0; i < 6; i++) {
        const Lanes slope = p[i] * stack.step, rest = q[i] - p[i] * stack.end, bound = rest / slope;
        high = slope > 0 ? least(high, bound) : high;
        low = slope < 0 ? most(low, bound) : low;
        meets &= (slope != 0) | (rest >= 0);
    }
    meets &= low <= high;
    low = pick(meets, low, Lanes{}), high = pick(meets, high, Lanes{});
    const IntLanes below = truncated(low), first = stack.planes - 1 - truncated(high);
    Walks<CELLS> walks;
    walks.last = stack.planes - 1 - below + (real(below) < low); // a condition that holds is -1
    walks.x_step = -bend_u * stack.step * head.u_scale, walks.y_step = -bend_v * stack.step * head.v_scale;
    walks.x_last = (u + bend_u * stack.end - head.u0) * head.u_scale;
    walks.y_last = (v + bend_v * stack.end - head.v0) * head.v_scale;
    walks.oz = o[2], walks.dz = d[2];
    walks.begin(scene.columns, stack, first, meets);
    return walks;
}

// By way of 16 bits: GCC 12 takes bytes apart one by one to make floats of them, for a quarter of a frame's time.
Lanes widened(const uint8_t* from) {
    ByteLanes codes;
    __builtin_memcpy(&codes, from, sizeof codes);
    return real(__builtin_convertvector(__builtin_convertvector(codes, ShortLanes), IntLanes));
}

// A sample that weighs enough.
struct Seen {
    float weight, inverse_t, fx, fy;
    int32_t head, texel;
};

// Colours and features of a sample, the features as sigmoids.
inline __attribute__((always_inline)) Lanes colors(const Scene& scene, const Seen& sample, Lanes low, Lanes step) {
    const int64_t C = scene.channels;
    const uint8_t* texel = scene.texels + sample.texel * C;
    const float fx = sample.fx, fy = sample.fy, gx = 1 - fx, gy = 1 - fy;
    const Lanes codes = widened(texel) * (gx * gy) + widened(texel + C) * (fx * gy) + widened(texel + 8 * C) * (gx * fy) +
                        widened(texel + 9 * C) * (fx * fy);
    return 1.0f / (1.0f + exp_lanes(-(low + step * codes)));
}

// Marches sixteen rays, and sixteen others after them.
class Marcher {
  public:
    std::vector<Seen> seen[WIDTH]; // the first `count`: samples of each ray that weigh enough, front to back
    int64_t count[WIDTH];

    Marcher(const Scene& scene, float threshold, float* peaks)
        : scene(scene), threshold(threshold), peaks(peaks), walks(scene.num_heads) {
        int64_t most = 1;
        for (int64_t h = 0; h < scene.num_heads; h++) most += scene.heads[h].stack.planes;
        for (auto& samples : seen) samples.resize(most);
    }

    // The light that passes each ray; those that are not `there` are left out.
    Lanes march(const Packet& rays, Mask there) {
        for (int64_t h = 0; h < scene.num_heads; h++) walks[h] = begin(scene, scene.heads[h], rays);
        std::fill(count, count + WIDTH, 0);
        light = splat(1);
        walk_abreast(
            int32_t(scene.num_heads), [&](int32_t h) { return walks[h].inverse_t; },
            [&] { return ~there | (light <= OPAQUE); }, [&](int32_t h, Mask going) { step(h, going); });
        return light;
    }

  private:
    const Scene& scene;
    const float threshold;
    float* const peaks; // of every texel, or null
    std::vector<Walks<CELLS>> walks;
    Lanes light;

    // Rays of `going` take their next sample of one MPI.
    void step(int32_t h, Mask going) {
        const Head& head = scene.heads[h];
        Walks<CELLS>& walk = walks[h];
        IntLanes column, row;
        Lanes fx, fy;
        walk.cell(head.stack, column, row, fx, fy);
        const IntLanes texel = pick(going, walk.brick * 64 + row * 8 + column, IntLanes{});
        const auto pair = [this](int32_t at) { // a texel and the one right of it, in the lowest bytes
            int32_t codes;
            __builtin_memcpy(&codes, scene.density + at, sizeof codes);
            return codes;
        };
        const IntLanes upper = each_lane<IntLanes>(texel, pair), lower = each_lane<IntLanes>(texel + 8, pair);
        const auto along = [&](IntLanes codes) {
            const Lanes first = real(codes & 255);
            return first + fx * (real((codes >> 8) & 255) - first);
        };
        const Lanes above = along(upper), code = above + fy * (along(lower) - above);
        const IntLanes fine = pick(going, truncated(code * float(FINENESS) + 0.5f), IntLanes{});
        const Lanes found = each_lane<Lanes>(fine, [&head](int32_t at) { return head.pass[at]; });
        const Lanes pass = pick(going, found, splat(1)), weight = light * (1 - pass);
        keep(h, weight, walk.inverse_t, fx, fy, texel);
        if (peaks) raise(weight, texel);
        light *= pass;
        walk.next(scene.columns, head.stack, going);
    }

    // Notes the samples that weigh enough, and asks for their colours.
    void keep(int32_t h, Lanes weight, Lanes inverse_t, Lanes fx, Lanes fy, IntLanes texel) {
        const int64_t C = scene.channels;
        for (uint32_t lanes = bits(weight > threshold); lanes; lanes &= lanes - 1) {
            const int i = __builtin_ctz(lanes);
            seen[i][count[i]++] = {weight[i], inverse_t[i], fx[i], fy[i], h, texel[i]};
            const uint8_t* line = scene.texels + texel[i] * C;
            for (const uint8_t* row : {line, line + 8 * C}) __builtin_prefetch(row), __builtin_prefetch(row + 2 * C - 1);
        }
    }

    void raise(Lanes weight, IntLanes texel) {
        for (int i = 0; i < WIDTH; i++)
            for (const int32_t corner : CORNERS) {
                float& peak = peaks[texel[i] + corner];
                peak = std::max(peak, weight[i]); // rays that do not go on have weight 0
            }
    }
};

Packet packed(const float* origins, const float* directions, const float* nears, const float* fars, int64_t some) {
    Packet packet;
    for (int64_t i = 0; i < WIDTH; i++) {
        const int64_t ray = std::min(i, some - 1);
        for (int a = 0; a < 3; a++) {
            packet.origin[a][i] = origins[3 * ray + a];
            packet.direction[a][i] = directions[3 * ray + a];
        }
        packet.near[i] = nears[ray], packet.inverse_far[i] = 1 / fars[ray];
    }
    return packet;
}

// What a ray gathered: sums of weight times colours and features, and the inverse distance at half of the weight.
struct Sums {
    float total = 0, inverse_t = 0;
    Lanes gathered{};

    Sums(const Scene& scene, const Seen* seen, int64_t count, Lanes low, Lanes step, float* votes) {
        for (int64_t s = 0; s < count; s++) {
            gathered += seen[s].weight * colors(scene, seen[s], low, step);
            total += seen[s].weight;
            votes[seen[s].head] += seen[s].weight;
        }
        float half = 0;
        int64_t s = 0;
        while (s < count && (half += seen[s].weight) < 0.5f * total) s++;
        if (count) inverse_t = seen[std::min(s, count - 1)].inverse_t;
    }
};

} // namespace

extern "C" {

// Rays [begin, end). Sums of weight times colours and features, the weights' sum, the light that passes, the inverse
// distance at half of the weight, the head of most weight; and, where asked for, the largest weight that reads a texel.
void mmpi_march_baked(const Scene* scene, const float* origins, const float* directions, const float* nears,
                      const float* fars, float threshold, int64_t begin, int64_t end, float* sums, float* mass,
                      float* passing, float* inverse_t, int64_t* winner, float* peaks) {
    const int64_t C = scene->channels;
    Marcher marcher(*scene, threshold, peaks);
    std::vector<float> votes(scene->num_heads);
    const Lanes low = load(scene->low), step = load(scene->step);
    for (int64_t first = begin; first < end; first += WIDTH) {
        const int64_t some = std::min<int64_t>(WIDTH, end - first);
        const Packet rays = packed(origins + 3 * first, directions + 3 * first, nears + first, fars + first, some);
        const Lanes light = marcher.march(rays, IOTA < float(some));
        for (int64_t i = 0; i < some; i++) {
            const int64_t ray = first + i;
            std::fill(votes.begin(), votes.end(), 0.0f);
            const Sums found(*scene, marcher.seen[i].data(), marcher.count[i], low, step, votes.data());
            for (int64_t c = 0; c < C; c++)
                sums[ray * C + c] = c < COLORS ? found.gathered[c] : 2 * found.gathered[c] - found.total;
            mass[ray] = found.total;
            passing[ray] = light[i] > OPAQUE ? light[i] : 0;
            inverse_t[ray] = found.inverse_t;
            winner[ray] = std::max_element(votes.begin(), votes.end()) - votes.begin();
        }
    }
}
}
