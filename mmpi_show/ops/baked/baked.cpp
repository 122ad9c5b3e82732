// Rendering of rays from baked bricks (scene.py): bytes, of which a sample reads one brick alone. The example in
// NumPy is reader.py.
#include "parts.h"
#include "walk.h"

namespace {

constexpr int FINENESS = 8, COLORS = 3;
constexpr int32_t CORNERS[4] = {0, 1, 8, 9}; // of a cell, texels within a brick

struct BakedScene {
    int64_t num_mpis, channels;
    const Mpi* mpis;
    const Stack* stacks;
    const float* const* through; // of each MPI: e^-tau at codes 0, 1/8, ...
    const Column* columns;
    const uint8_t *density, *texels; // with some bytes behind each, which are read and not used
    const float *low, *step;         // of sixteen channels; features' doubled, for tanh x = 2 sigmoid(2 x) - 1
};

inline Lanes decoded(const uint8_t* from) {
    ByteLanes codes;
    __builtin_memcpy(&codes, from, sizeof codes);
    return real(widened(codes));
}

// Eight bytes each.
inline Lanes decoded(const uint8_t* left, const uint8_t* right) {
    typedef uint64_t Words __attribute__((vector_size(16)));
    Words words;
    __builtin_memcpy(&words, left, 8);
    uint64_t upper;
    __builtin_memcpy(&upper, right, 8);
    words[1] = upper;
    return real(widened((ByteLanes)words));
}

struct Bytes {
    static constexpr int CELLS = 7;
    static constexpr bool HAS_CUBE = false, ENDS_DARK = true;

    struct Reads {
        IntLanes texel;
        Lanes fx, fy;
    };
    struct Lookup {
        int32_t texel;
        float fx, fy;
    };

    const BakedScene& baked;
    const Scene scene{};
    const Column* columns;
    const Stack* stacks;
    const int64_t channels;
    const float threshold;
    float* const peaks; // of every texel, or null
    const Lanes low, range, low_twice, range_twice;

    Bytes(const BakedScene& baked, float threshold, float* peaks)
        : baked(baked), scene{baked.num_mpis, baked.num_mpis, 0, baked.mpis}, columns(baked.columns),
          stacks(baked.stacks), channels(baked.channels), threshold(threshold), peaks(peaks), low(load(baked.low)),
          range(load(baked.step)), low_twice(join(lower_half(low), lower_half(low))),
          range_twice(join(lower_half(range), lower_half(range))) {}

    Bounds bounds(int32_t) const { return {threshold, OPAQUE_BAKED}; }

    void look_ahead(int64_t k, const Walks<CELLS>& walk, Mask going, Reads& reads) const {
        IntLanes column, row;
        Lanes fx, fy;
        walk.cell(stacks[k], column, row, fx, fy);
        reads.texel = pick(going, walk.brick * 64 + row * 8 + column, reads.texel);
        reads.fx = pick(going, fx, reads.fx), reads.fy = pick(going, fy, reads.fy);
        for (int i = 0; i < WIDTH; i++) __builtin_prefetch(baked.density + reads.texel[i]);
    }

    Lanes through(int32_t k, Mask going, const Reads& reads) const {
        const auto pair = [this](int32_t at) { // a texel and the one right of it, in the lowest bytes
            int32_t codes;
            __builtin_memcpy(&codes, baked.density + at, sizeof codes);
            return codes;
        };
        const auto along = [&](IntLanes codes) {
            const Lanes first = real(codes & 255);
            return first + reads.fx * (real((codes >> 8) & 255) - first);
        };
        const IntLanes upper = each_lane<IntLanes>(reads.texel, pair), lower = each_lane<IntLanes>(reads.texel + 8, pair);
        const Lanes above = along(upper), code = above + reads.fy * (along(lower) - above);
        const IntLanes fine = pick(going, truncated(code * float(FINENESS) + 0.5f), IntLanes{});
        const float* table = baked.through[k];
        return each_lane<Lanes>(fine, [table](int32_t at) { return table[at]; });
    }

    // Raises peaks; rays that do not go on have weight 0. Weights are not negative, so their bits are in their order,
    // and the largest one stays whatever the order of threads.
    void weighed(const Reads& reads, Lanes weight) const {
        for (int i = 0; peaks && i < WIDTH; i++)
            for (const int32_t corner : CORNERS) {
                int32_t* const peak = reinterpret_cast<int32_t*>(peaks + reads.texel[i] + corner);
                const int32_t own = as_int(weight)[i];
                int32_t so_far = __atomic_load_n(peak, __ATOMIC_RELAXED);
                while (so_far < own && !__atomic_compare_exchange_n(peak, &so_far, own, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
                }
            }
    }

    // What one of the samples reads, which is asked for at once.
    void look_up(const Reads& reads, int lane, Lookup& sample) const {
        const uint8_t* line = baked.texels + reads.texel[lane] * channels;
        for (const uint8_t* row : {line, line + 8 * channels})
            __builtin_prefetch(row), __builtin_prefetch(row + 2 * channels - 1);
        sample = {reads.texel[lane], reads.fx[lane], reads.fy[lane]};
    }

    Lanes colors(const Lookup& at, int64_t) const {
        const float gx = 1 - at.fx, gy = 1 - at.fy;
        const uint8_t* texel = baked.texels + at.texel * channels;
        return activated(decoded(texel) * (gx * gy) + decoded(texel + channels) * (at.fx * gy) +
                             decoded(texel + 8 * channels) * (gx * at.fy) + decoded(texel + 9 * channels) * (at.fx * at.fy),
                         low, range, IOTA);
    }

    Lanes colors(const Lookup& a, const Lookup& b) const {
        const uint8_t *left = baked.texels + a.texel * OCTET, *right = baked.texels + b.texel * OCTET;
        const Lanes fx = either(a.fx, b.fx), fy = either(a.fy, b.fy), gx = 1 - fx, gy = 1 - fy;
        return activated(decoded(left, right) * (gx * gy) + decoded(left + OCTET, right + OCTET) * (fx * gy) +
                             decoded(left + 8 * OCTET, right + 8 * OCTET) * (gx * fy) +
                             decoded(left + 9 * OCTET, right + 9 * OCTET) * (fx * fy),
                         low_twice, range_twice, EIGHT_TWICE);
    }

  private:
    static Lanes either(float a, float b) { return join(a - Octet{}, b - Octet{}); }

    static Lanes activated(Lanes codes, Lanes low, Lanes range, Lanes channel) {
        const Lanes share = 1.0f / (1.0f + exp_lanes(-(low + range * codes)));
        return pick(channel < float(COLORS), share, 2.0f * share - 1.0f);
    }
};

// Where peaks are asked for, the largest weight that reads a texel is written there.
void mmpi_render_baked(int64_t begin, int64_t end, const BakedScene* scene, const Rays* rays, float threshold,
                     float* peaks, const Outputs* to) {
    render(Bytes(*scene, threshold, peaks), *rays, begin, end, *to);
}

} // namespace

IN_PARTS(mmpi_render_baked)
