// Rays through baked multi-plane images (scene/baked.py): all MPIs at once by distance, from brick to brick, until a ray
// is opaque. What it gathers is read afterwards, all channels of a texel at once. The reference is reference.py.
#include "lanes.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

namespace {

constexpr float OPAQUE = 1e-2f; // a ray that lets less through is over
constexpr int CELLS = 7, WORD = 32, FINENESS = 8, COLORS = 3;
constexpr int32_t CORNERS[4] = {0, 1, 8, 9}; // of a cell, texels within a brick
typedef uint8_t ByteLanes __attribute__((vector_size(16)));

struct Column {
    uint32_t planes; // a bit each
    int32_t first;   // brick of the lowest bit
};

struct Head {
    float origin[3], axes[3][3];
    float u0, v0, u1, v1, u_scale, v_scale; // texel = (u - u0) * u_scale
    float step, end;                        // disparity between planes and of the last one
    int32_t planes, height, width, down, across;
    int32_t first_column;
    const float* pass; // e^-tau at codes 0, 1/8, ...
};

struct Scene {
    int64_t num_heads, channels;
    const Head* heads;
    const Column* columns;
    const uint8_t *density, *texels;
    const float *low, *step; // of sixteen channels; features' doubled, for tanh x = 2 sigmoid(2 x) - 1
};

// A ray on its way through one MPI. Planes are counted from the nearest one.
struct Walk {
    float x0, x_step, x_turns, y0, y_step, y_turns; // texel on plane l: x0 + l x_step; turns: 1 / step
    float oz, dz, inverse_t;
    int32_t left, top; // of the tile, texels
    int32_t exit, last, plane, brick, word;
    uint32_t ahead; // planes of the column that are still to come

    // Sets out at the first plane that the ray can meet; false where there is none.
    bool begin(const Head& head, const float* from, const float* to, float near, float inverse_far) {
        float o[3], d[3], relative[3];
        for (int a = 0; a < 3; a++) relative[a] = from[a] - head.origin[a];
        for (int a = 0; a < 3; a++) {
            o[a] = head.axes[a][0] * relative[0] + head.axes[a][1] * relative[1] + head.axes[a][2] * relative[2];
            d[a] = head.axes[a][0] * to[0] + head.axes[a][1] * to[1] + head.axes[a][2] * to[2];
        }
        if (!(d[2] > 1e-6f)) return false;
        const float u = d[0] / d[2], v = d[1] / d[2], bend_u = o[0] - o[2] * u, bend_v = o[1] - o[2] * v;
        // Half-spaces p w <= q in disparity, as in scene/geometry.py.
        const float p[6] = {d[2] * near + o[2], -(d[2] + o[2] * inverse_far), bend_u, -bend_u, bend_v, -bend_v};
        const float q[6] = {1, -inverse_far, head.u1 - u, u - head.u0, head.v1 - v, v - head.v0};
        const float farthest = float(head.planes - 1);
        float low = 0, high = farthest; // planes counted from the last one
        for (int i = 0; i < 6; i++) {
            const float slope = p[i] * head.step, rest = q[i] - p[i] * head.end;
            if (slope > 0) high = std::min(high, rest / slope);
            else if (slope < 0) low = std::max(low, rest / slope);
            else if (rest < 0) return false;
        }
        if (!(low <= high)) return false;
        const int32_t first = head.planes - 1 - int32_t(std::floor(high));
        last = head.planes - 1 - int32_t(std::ceil(low));
        if (first > last) return false;
        x_step = -bend_u * head.step * head.u_scale, y_step = -bend_v * head.step * head.v_scale;
        x0 = (u + bend_u * head.end - head.u0) * head.u_scale - farthest * x_step;
        y0 = (v + bend_v * head.end - head.v0) * head.v_scale - farthest * y_step;
        x_turns = 1 / x_step, y_turns = 1 / y_step;
        oz = o[2], dz = d[2], exit = first - 1, ahead = 0;
        return true;
    }

    // Plane at which the ray has left a tile along one axis; a ray parallel to it never does.
    static float leaves(float start, float step, float turns, int32_t lower) {
        const float end = float(step > 0 ? lower + CELLS : lower);
        return step == 0 ? std::numeric_limits<float>::infinity() : (end - start) * turns;
    }

    // On to the next plane that holds something; false where there is none.
    bool next(const Scene& scene, const Head& head) {
        while (!ahead) {
            const int32_t l = exit + 1;
            if (l > last) return false;
            const float x = x0 + float(l) * x_step, y = y0 + float(l) * y_step;
            const int32_t across = std::min(std::max(int32_t(x * (1.0f / CELLS)), 0), head.across - 1);
            const int32_t down = std::min(std::max(int32_t(y * (1.0f / CELLS)), 0), head.down - 1);
            word = l / WORD;
            left = across * CELLS, top = down * CELLS;
            const Column column = scene.columns[head.first_column + (word * head.down + down) * head.across + across];
            const float leaving = std::min(leaves(x0, x_step, x_turns, left), leaves(y0, y_step, y_turns, top));
            exit = std::min(last, word * WORD + WORD - 1);
            if (leaving < float(exit)) exit = std::max(l, int32_t(leaving));
            const uint32_t from = ~0u << (l & 31);
            ahead = column.planes & from & (~0u >> (31 - (exit & 31)));
            brick = column.first + __builtin_popcount(column.planes & ~from) - 1;
        }
        plane = word * WORD + __builtin_ctz(ahead);
        ahead &= ahead - 1;
        brick++;
        const float w = float(head.planes - 1 - plane) * head.step + head.end;
        __builtin_prefetch(scene.density + int64_t(brick) * 64);
        inverse_t = w * dz / (1 - w * oz);
        return true;
    }

    // Lower texel in the brick, and fractions.
    int32_t cell(float& fx, float& fy) const {
        const float x = std::min(std::max(x0 + float(plane) * x_step - float(left), 0.0f), float(CELLS));
        const float y = std::min(std::max(y0 + float(plane) * y_step - float(top), 0.0f), float(CELLS));
        const int32_t column = std::min(int32_t(x), CELLS - 1), row = std::min(int32_t(y), CELLS - 1);
        fx = x - float(column), fy = y - float(row);
        return row * 8 + column;
    }
};

Lanes widened(const uint8_t* from) {
    ByteLanes codes;
    __builtin_memcpy(&codes, from, sizeof codes);
    return __builtin_convertvector(codes, Lanes);
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

struct Rays {
    const float *origins, *directions, *nears, *fars;
};

// Marches one ray after the other.
class Marcher {
  public:
    std::vector<Seen> seen; // the first `count`: samples of the last ray that weigh enough, front to back
    int64_t count = 0;

    Marcher(const Scene& scene, float threshold, float* peaks)
        : scene(scene), threshold(threshold), peaks(peaks), walks(scene.num_heads), nearest(scene.num_heads) {
        int64_t most = 1;
        for (int64_t h = 0; h < scene.num_heads; h++) most += scene.heads[h].planes;
        seen.resize(most);
    }

    // The light that passes a ray.
    float march(const Rays& rays, int64_t ray) {
        const int64_t H = scene.num_heads;
        const float near = rays.nears[ray], inverse_far = 1 / rays.fars[ray];
        for (int64_t h = 0; h < H; h++) {
            const Head& head = scene.heads[h];
            const bool meets =
                walks[h].begin(head, rays.origins + 3 * ray, rays.directions + 3 * ray, near, inverse_far) &&
                walks[h].next(scene, head);
            nearest[h] = meets ? walks[h].inverse_t : -1;
        }
        float light = 1;
        count = 0;
        while (light > OPAQUE) {
            int64_t best = 0;
            float top = nearest[0];
            for (int64_t h = 1; h < H; h++) { // ties: the first head
                best = nearest[h] > top ? h : best;
                top = nearest[h] > top ? nearest[h] : top;
            }
            if (top < 0) break;
            Walk& walk = walks[best];
            float fx, fy;
            const int32_t texel = walk.brick * 64 + walk.cell(fx, fy);
            const uint8_t* code = scene.density + texel;
            const float above = float(code[0]) + fx * float(code[1] - code[0]);
            const float below = float(code[8]) + fx * float(code[9] - code[8]);
            const float pass = scene.heads[best].pass[int32_t((above + fy * (below - above)) * FINENESS + 0.5f)];
            const float weight = light * (1 - pass);
            seen[count] = {weight, top, fx, fy, int32_t(best), texel};
            count += weight > threshold;
            if (peaks)
                for (const int32_t corner : CORNERS) peaks[texel + corner] = std::max(peaks[texel + corner], weight);
            light *= pass;
            nearest[best] = walk.next(scene, scene.heads[best]) ? walk.inverse_t : -1;
        }
        return light;
    }

  private:
    const Scene& scene;
    const float threshold;
    float* const peaks; // of every texel, or null
    std::vector<Walk> walks;
    std::vector<float> nearest; // 1 / distance of each head's next sample; -1: none
};

} // namespace

extern "C" {

// Rays [begin, end). Sums of weight times colours and features, the weights' sum, the light that passes, the inverse
// distance at half of the weight, the head of most weight; and, where asked for, the largest weight that reads a texel.
void mmpi_march_baked(const Scene* scene, const float* origins, const float* directions, const float* nears,
                      const float* fars, float threshold, int64_t begin, int64_t end, float* sums, float* mass,
                      float* passing, float* inverse_t, int64_t* winner, float* peaks) {
    const int64_t C = scene->channels;
    const Rays rays{origins, directions, nears, fars};
    Marcher marcher(*scene, threshold, peaks);
    const std::vector<Seen>& seen = marcher.seen;
    std::vector<float> votes(scene->num_heads);
    const Lanes low = load(scene->low), step = load(scene->step);
    for (int64_t ray = begin; ray < end; ray++) {
        const float light = marcher.march(rays, ray);
        const int64_t count = marcher.count;
        for (int64_t s = 0; s < count; s++) {
            const uint8_t* texel = scene->texels + seen[s].texel * C;
            __builtin_prefetch(texel), __builtin_prefetch(texel + 10 * C - 1);
        }
        float total = 0;
        Lanes gathered{};
        std::fill(votes.begin(), votes.end(), 0.0f);
        for (int64_t s = 0; s < count; s++) {
            gathered += seen[s].weight * colors(*scene, seen[s], low, step);
            total += seen[s].weight;
            votes[seen[s].head] += seen[s].weight;
        }
        for (int64_t c = 0; c < C; c++) sums[ray * C + c] = c < COLORS ? gathered[c] : 2 * gathered[c] - total;
        mass[ray] = total;
        passing[ray] = light > OPAQUE ? light : 0;
        float half = 0;
        int64_t s = 0;
        while (s < count && (half += seen[s].weight) < 0.5f * total) s++;
        inverse_t[ray] = count ? seen[std::min(s, count - 1)].inverse_t : 0;
        winner[ray] = std::max_element(votes.begin(), votes.end()) - votes.begin();
    }
}
}
