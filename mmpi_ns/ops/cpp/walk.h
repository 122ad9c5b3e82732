// The walk of all images: sixteen rays abreast through all heads, near to far, from one stored brick to the next, until
// each terminates; then the values of the kept samples, ray by ray. Templated on the storage of texels: floats in the
// bricks of training (march/render.cpp) or bytes in baked bricks (baked/baked.cpp).
//
// Training (march/march.cpp) shares crossings.h and blend.h, and steps one ray at a time and each head's samples in blocks:
// its rays are drawn at random, so sixteen of them go different ways. Abreast, 4,096 of them take 2.2 times as long (40
// instead of 18 ms, next to nothing kept), and a frame's rays, which are neighbours, 0.7 times (48 instead of 69 ms).
#pragma once
#include "blend.h"
#include "table.h"

namespace {

constexpr int WORD = 32;

// The bricks of a tile in 32 consecutive planes (scene/baked.py).
struct Column {
    int32_t planes; // a bit each
    int32_t first;  // brick of the lowest bit; the others follow it
};

// The planes of one MPI, with the coordinates of their texels and columns.
struct Stack {
    float step, end;        // disparity between planes and of the last one
    float u0, v0;           // texel = (u - u0) x_scale
    float x_scale, y_scale;
    int32_t planes, height, width, down, across;
    int32_t first_column;
};

inline IntLanes ones(IntLanes x) {
    return each_lane<IntLanes>(x, [](int32_t word) { return int32_t(__builtin_popcount(uint32_t(word))); });
}

// Sixteen rays on their way through one MPI. A tile is CELLS x CELLS cells (squares between four texels) of a plane.
// Planes are counted from the nearest one. Lanes of terminated rays are not used.
template <int CELLS> struct Walks {
    Lanes x_last, x_step, x_turns, y_last, y_step, y_turns; // texel on the last plane, from plane to plane; turns: 1 / step
    Lanes oz, dz;
    Lanes inverse_t;    // of the sample at hand; -1 where there is none
    IntLanes left, top; // of the tile, texels
    IntLanes exit, last, plane, brick, word;
    IntLanes ahead; // planes of the column that are still to come

    // Starts the rays of `going`.
    void begin(const Column* columns, const Stack& stack, const Crossing& at, Mask going) {
        x_last = (at.u + stack.end * at.u_slope - stack.u0) * stack.x_scale;
        y_last = (at.v + stack.end * at.v_slope - stack.v0) * stack.y_scale;
        x_step = -stack.step * at.u_slope * stack.x_scale, y_step = -stack.step * at.v_slope * stack.y_scale;
        x_turns = 1 / x_step, y_turns = 1 / y_step;
        oz = at.origin[2], dz = at.direction[2];
        exit = stack.planes - 2 - at.first, last = exit + at.count;
        inverse_t = splat(-1), left = top = plane = brick = word = ahead = IntLanes{};
        next(columns, stack, going & (at.count > 0));
    }

    // Advances the rays of `going` to the next occupied plane.
    void next(const Column* columns, const Stack& stack, Mask going) {
        for (;;) {
            const IntLanes l = exit + 1;
            const Mask searching = going & (ahead == 0) & (l <= last);
            if (!any(searching)) break;
            search(columns, stack, l, searching);
        }
        inverse_t = pick(going, splat(-1), inverse_t);
        going &= ahead != 0;
        const IntLanes lowest = ahead & -ahead;
        plane = pick(going, word * WORD + ones(lowest - 1), plane);
        ahead = pick(going, ahead ^ lowest, ahead);
        brick -= going;
        const Lanes w = real(stack.planes - 1 - plane) * stack.step + stack.end;
        inverse_t = pick(going, most(w * dz / (1 - w * oz), Lanes{}), inverse_t);
    }

    // Lower texel in the tile, and fractions.
    void cell(const Stack& stack, IntLanes& column, IntLanes& row, Lanes& fx, Lanes& fy) const {
        const Lanes back = real(plane - (stack.planes - 1));
        column = within(x_last + back * x_step, left, stack.width, fx);
        row = within(y_last + back * y_step, top, stack.height, fy);
    }

  private:
    static IntLanes within(Lanes texel, IntLanes lower, int32_t texels, Lanes& fraction) {
        const IntLanes cells = least(whole(CELLS), texels - 1 - lower);
        const Lanes x = least(most(texel - real(lower), Lanes{}), real(cells));
        const IntLanes cell = least(truncated(x), cells - 1);
        fraction = x - real(cell);
        return cell;
    }

    // Looks up the columns that rays enter at planes l, and the plane at which each ray leaves its column.
    void search(const Column* columns, const Stack& stack, IntLanes l, Mask searching) {
        const Lanes back = real(l - (stack.planes - 1));
        const IntLanes across = pick(searching, tile(x_last + back * x_step, stack.across), IntLanes{});
        const IntLanes down = pick(searching, tile(y_last + back * y_step, stack.down), IntLanes{});
        const IntLanes at_word = pick(searching, l >> 5, IntLanes{});
        const IntLanes place = stack.first_column + (at_word * stack.down + down) * stack.across + across;
        const IntLanes planes = gather(&columns->planes, 2 * place);
        const IntLanes first = gather(&columns->first, 2 * place);
        const IntLanes at_left = across * CELLS, at_top = down * CELLS;
        const Lanes leaving = float(stack.planes - 1) + least(leaves(x_last, x_step, x_turns, at_left),
                                                              leaves(y_last, y_step, y_turns, at_top));
        IntLanes end = least(last, at_word * WORD + (WORD - 1));
        end = pick(leaving < real(end), most(l, truncated(leaving)), end);
        const IntLanes before = ~(whole(-1) << (l & 31)), within = ~(whole(-2) << (end & 31));
        left = pick(searching, at_left, left), top = pick(searching, at_top, top);
        word = pick(searching, at_word, word), exit = pick(searching, end, exit);
        ahead = pick(searching, planes & ~before & within, ahead);
        brick = pick(searching, first + ones(planes & before) - 1, brick);
    }

    static IntLanes tile(Lanes texel, int32_t tiles) {
        return least(most(truncated(texel * (1.0f / CELLS)), IntLanes{}), whole(tiles - 1));
    }

    // Planes behind the last one at which rays leave a tile along one axis; a ray parallel to it never does.
    static Lanes leaves(Lanes last, Lanes step, Lanes turns, IntLanes lower) {
        const Lanes end = real(lower + pick(step > 0, whole(CELLS), IntLanes{}));
        return pick(step == 0, splat(std::numeric_limits<float>::infinity()), (end - last) * turns);
    }
};

// The same through the cube.
struct CubeWalks {
    IntLanes index, last;
    Lanes inverse_t = splat(-1);

    void arrive(const Cube& cube, Mask going) {
        const Lanes here = 1 / ((real(index) + 0.5f) * cube.step);
        inverse_t = pick(going, pick(index <= last, here, splat(-1)), inverse_t);
    }
};

// Bounds for keeping samples and for termination.
struct Bounds {
    float weight, transmittance; // what a kept sample exceeds, and at which a ray terminates

    static Bounds exact(float threshold, float fair_share, int64_t samples) {
        if (threshold <= 0) return {-1, -1};
        const float weight = std::min(fair_share / float(std::max<int64_t>(samples, 1)), threshold);
        return {weight, std::min(weight, OPAQUE)};
    }
};

struct Outputs {
    float *gathered, *mass, *transmittance, *accumulation, *inverse_t, *winner, *dropped; // [R, C], [R, 1]
};

// Texels define what sixteen samples read (Reads), their transmittance, and what one of them holds (Lookup).
template <typename Texels> class Walker {
  public:
    explicit Walker(const Texels& texels)
        : texels(texels), scene(texels.scene), walks(scene.num_mpis), reads(scene.num_heads), blending(scene),
          masses(scene.num_heads) {}

    // Starts with `some` rays from number `first` on.
    void begin(const Rays& rays, int64_t first, int64_t some) {
        packet = Packet(rays, first, some);
        this->first = first, this->some = some;
        crossings.cross(scene, rays, packet);
        transmittance = splat(1), dropped = Lanes{};
        for (auto& samples : seen) samples.clear();
        const auto bounds = [&](int32_t samples) { return texels.bounds(samples); };
        least_weight = each_lane<Lanes>(crossings.total, [&](int32_t samples) { return bounds(samples).weight; });
        const auto transmittances = [&](int32_t samples) { return bounds(samples).transmittance; };
        least_transmittance = each_lane<Lanes>(crossings.total, transmittances);
        for (int64_t k = 0; k < scene.num_mpis; k++) {
            walks[k].begin(texels.columns, texels.stacks[k], crossings.mpis[k], packet.there);
            look_ahead(k, packet.there);
        }
        if constexpr (Texels::HAS_CUBE) {
            cube.inverse_t = splat(-1), cube.index = crossings.cube.first;
            cube.last = cube.index + crossings.cube.count - 1;
            if (scene.num_heads > scene.num_mpis) cube.arrive(*scene.cube, packet.there);
        }
    }

    // The ray with the nearest next sample goes first, with all rays whose next sample is in the same head: so they
    // stay abreast, and each takes its samples in order. False where none has a next sample.
    bool advance() {
        Lanes top = next(0);
        IntLanes best{};
        for (int32_t h = 1; h < scene.num_heads; h++) { // ties: the first head
            best = pick(next(h) > top, whole(h), best);
            top = most(next(h), top);
        }
        const Mask active = (top >= 0) & ~(transmittance <= least_transmittance); // not is_terminated
        if (!any(active)) return false;
        const Lanes waiting = pick(active, top, splat(-1));
        const int32_t h = best[__builtin_ctz(bits(waiting == largest(waiting)))];
        step(h, active & (best == h));
        return true;
    }

    // The transmittance of a terminated ray bounds the weights of the rest of its samples.
    void finish(const Outputs& to) {
        Mask rest = transmittance <= least_transmittance;
        if (!Texels::ENDS_DARK) {
            Mask unseen = cube.inverse_t >= 0;
            for (const auto& walk : walks) unseen |= walk.inverse_t >= 0;
            rest = unseen;
        }
        dropped += pick(rest, transmittance, Lanes{});
        if (Texels::ENDS_DARK) transmittance = pick(rest, Lanes{}, transmittance);
        for (int64_t i = 0; i < some; i++) {
            sum(seen[i], first + i, to);
            to.transmittance[first + i] = transmittance[i], to.accumulation[first + i] = 1 - transmittance[i];
            to.dropped[first + i] = dropped[i];
        }
    }

  private:
    using Reads = typename Texels::Reads;

    // A kept sample.
    struct Seen {
        float weight, inverse_t;
        int32_t head;
        typename Texels::Lookup lookup;
    };

    const Texels& texels;
    const Scene& scene;
    Packet packet;
    int64_t first = 0, some = 0;
    Crossings crossings;
    std::vector<Walks<Texels::CELLS>> walks;
    std::vector<Reads> reads; // of the next samples in each head
    CubeWalks cube;
    std::vector<Seen> seen[WIDTH]; // of each ray, front to back
    Lanes transmittance, dropped, least_weight, least_transmittance;
    Blending blending;
    std::vector<float> masses;

    Lanes next(int32_t head) const {
        return Texels::HAS_CUBE && head == scene.num_mpis ? cube.inverse_t : walks[head].inverse_t;
    }

    // Takes the next sample of one head for the rays of `going`.
    void step(int32_t h, Mask going) {
        const Lanes inverse_t = next(h);
        Reads& at = reads[h];
        Lanes through;
        if constexpr (Texels::HAS_CUBE) {
            Lanes tau = h == scene.num_mpis ? texels.cube_tau(cube.index, packet, going, at)
                                            : texels.tau(h, walks[h], going, at);
            if (texels.blends) {
                const auto axes = [&](int64_t k) -> const LocalRays& { return crossings.mpis[k]; };
                tau = blending.blended(packet, axes, h, inverse_t, tau, going);
            }
            through = exp_lanes(-tau);
        } else {
            through = texels.through(h, going, at);
        }
        through = pick(going, through, splat(1));
        const Lanes weight = transmittance * (1 - through);
        texels.weighed(at, weight);
        const Mask kept = going & (weight > least_weight);
        for (uint32_t lanes = bits(kept); lanes; lanes &= lanes - 1) {
            const int i = __builtin_ctz(lanes);
            Seen& sample = seen[i].emplace_back(); // written in place: a copy would wait for the store
            sample.weight = weight[i], sample.inverse_t = inverse_t[i], sample.head = h;
            texels.look_up(at, i, sample.lookup);
        }
        dropped += pick(kept, Lanes{}, weight);
        transmittance *= through;
        if (Texels::HAS_CUBE && h == scene.num_mpis) {
            cube.index -= going, cube.arrive(*scene.cube, going);
        } else {
            walks[h].next(texels.columns, texels.stacks[h], going);
            look_ahead(h, going);
        }
    }

    // What the next samples of the rays of `going` read in an MPI is looked up and prefetched now: other heads, and the
    // other walk, come first.
    void look_ahead(int64_t k, Mask going) {
        texels.look_ahead(k, walks[k], going & (walks[k].inverse_t >= 0), reads[k]);
    }

    void gather(const std::vector<Seen>& samples, float* to) const {
        for (int64_t first = 0; first < texels.channels; first += WIDTH) {
            Lanes total{};
            for (const Seen& s : samples) total += s.weight * texels.colors(s.lookup, first);
            for (int64_t c = first; c < std::min(texels.channels, first + WIDTH); c++) to[c] = total[c - first];
        }
    }

    // Of eight channels, two samples at once.
    void gather_pairs(const std::vector<Seen>& samples, float* to) const {
        Octet total{};
        for (size_t n = 0; n < samples.size(); n += 2) {
            const Seen &a = samples[n], &b = samples[std::min(n + 1, samples.size() - 1)];
            const Lanes values = texels.colors(a.lookup, b.lookup);
            total += a.weight * lower_half(values);
            if (&a != &b) total += b.weight * upper_half(values);
        }
        __builtin_memcpy(to, &total, sizeof total);
    }

    // Sums of a ray, its depth, and its head of largest weight.
    void sum(const std::vector<Seen>& samples, int64_t ray, const Outputs& to) {
        if (texels.channels == OCTET)
            gather_pairs(samples, to.gathered + ray * OCTET);
        else
            gather(samples, to.gathered + ray * texels.channels);
        std::fill(masses.begin(), masses.end(), 0.0f);
        float mass = 0, passed = 0;
        for (const Seen& s : samples) mass += s.weight, masses[s.head] += s.weight;
        to.mass[ray] = mass, to.inverse_t[ray] = 0;
        to.winner[ray] = float(std::max_element(masses.begin(), masses.end()) - masses.begin());
        for (size_t n = 0; n < samples.size() && mass > 0; n++) {
            to.inverse_t[ray] = samples[n].inverse_t;
            if (is_depth(passed += samples[n].weight, mass)) break;
        }
    }
};

// Rays [begin, end): two walks in turn, so that one computes while the other waits for memory.
template <typename Texels>
void render(const Texels& texels, const Rays& rays, int64_t begin, int64_t end, const Outputs& to) {
    Walker<Texels> first(texels), second(texels);
    for (int64_t ray = begin; ray < end; ray += 2 * WIDTH) {
        const int64_t next = std::min(ray + WIDTH, end), rest = std::min<int64_t>(WIDTH, end - next);
        bool first_goes = true, second_goes = rest > 0;
        first.begin(rays, ray, next - ray);
        if (second_goes) second.begin(rays, next, rest);
        while (first_goes || second_goes) {
            first_goes = first_goes && first.advance();
            second_goes = second_goes && second.advance();
        }
        first.finish(to);
        if (rest > 0) second.finish(to);
    }
}

} // namespace
