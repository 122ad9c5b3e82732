// Sixteen rays on their way through a baked multi-plane image (scene/baked.py), each from one plane that holds
// something to the next.
#pragma once
#include "lanes.h"

#include <limits>

namespace {

constexpr int CELLS = 7, WORD = 32;

struct Column {
    int32_t planes; // a bit each
    int32_t first;  // brick of the lowest bit
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
    const uint8_t *density, *texels; // with some bytes behind each, which are read and not used
    const float *low, *step;         // of sixteen channels; features' doubled, for tanh x = 2 sigmoid(2 x) - 1
};

struct Packet {
    Lanes origin[3], direction[3], near, inverse_far;
};

inline IntLanes ones(IntLanes x) {
    return each_lane<IntLanes>(x, [](int32_t word) { return int32_t(__builtin_popcount(uint32_t(word))); });
}

// Planes are counted from the nearest one. What lanes hold whose rays are over is not used.
struct Walks {
    Lanes x0, x_step, x_turns, y0, y_step, y_turns; // texel on plane l: x0 + l x_step; turns: 1 / step
    Lanes oz, dz;
    Lanes inverse_t;    // of the sample at hand; -1 where there is none
    IntLanes left, top; // of the tile, texels
    IntLanes exit, last, plane, brick, word;
    IntLanes ahead; // planes of the column that are still to come

    // Sets out at the first plane that each ray can meet.
    void begin(const Scene& scene, const Head& head, const Packet& rays) {
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
        const float farthest = float(head.planes - 1);
        Mask meets = d[2] > 1e-6f;
        Lanes low{}, high = splat(farthest); // planes counted from the last one
        for (int i = 0; i < 6; i++) {
            const Lanes slope = p[i] * head.step, rest = q[i] - p[i] * head.end, bound = rest / slope;
            high = slope > 0 ? least(high, bound) : high;
            low = slope < 0 ? most(low, bound) : low;
            meets &= (slope != 0) | (rest >= 0);
        }
        meets &= low <= high;
        low = pick(meets, low, Lanes{}), high = pick(meets, high, Lanes{});
        const IntLanes below = truncated(low), first = head.planes - 1 - truncated(high);
        last = head.planes - 1 - below + (real(below) < low); // a condition that holds is -1
        x_step = -bend_u * head.step * head.u_scale, y_step = -bend_v * head.step * head.v_scale;
        x0 = (u + bend_u * head.end - head.u0) * head.u_scale - farthest * x_step;
        y0 = (v + bend_v * head.end - head.v0) * head.v_scale - farthest * y_step;
        x_turns = 1 / x_step, y_turns = 1 / y_step;
        oz = o[2], dz = d[2], exit = first - 1;
        inverse_t = splat(-1), left = top = plane = brick = word = ahead = IntLanes{};
        next(scene, head, meets & (first <= last));
    }

    // Rays of `going` go on to the next plane that holds something.
    void next(const Scene& scene, const Head& head, Mask going) {
        for (;;) {
            const IntLanes l = exit + 1;
            const Mask searching = going & (ahead == 0) & (l <= last);
            if (!any(searching)) break;
            search(scene, head, l, searching);
        }
        inverse_t = pick(going, splat(-1), inverse_t);
        going &= ahead != 0;
        const IntLanes lowest = ahead & -ahead;
        plane = pick(going, word * WORD + ones(lowest - 1), plane);
        ahead = pick(going, ahead ^ lowest, ahead);
        brick -= going;
        const Lanes w = real(head.planes - 1 - plane) * head.step + head.end;
        inverse_t = pick(going, w * dz / (1 - w * oz), inverse_t);
    }

    // Lower texel in the brick, and fractions.
    IntLanes cell(Lanes& fx, Lanes& fy) const {
        const Lanes x = least(most(x0 + real(plane) * x_step - real(left), Lanes{}), splat(CELLS));
        const Lanes y = least(most(y0 + real(plane) * y_step - real(top), Lanes{}), splat(CELLS));
        const IntLanes column = least(truncated(x), whole(CELLS - 1)), row = least(truncated(y), whole(CELLS - 1));
        fx = x - real(column), fy = y - real(row);
        return row * 8 + column;
    }

  private:
    // Looks up the columns that rays enter at planes l, and how far each goes in its own.
    void search(const Scene& scene, const Head& head, IntLanes l, Mask searching) {
        const IntLanes across = pick(searching, tile(x0 + real(l) * x_step, head.across), IntLanes{});
        const IntLanes down = pick(searching, tile(y0 + real(l) * y_step, head.down), IntLanes{});
        const IntLanes at_word = pick(searching, l >> 5, IntLanes{});
        const IntLanes place = head.first_column + (at_word * head.down + down) * head.across + across;
        const IntLanes planes = each_lane<IntLanes>(place, [&](int32_t at) { return scene.columns[at].planes; });
        const IntLanes first = each_lane<IntLanes>(place, [&](int32_t at) { return scene.columns[at].first; });
        const IntLanes at_left = across * CELLS, at_top = down * CELLS;
        const Lanes leaving = least(leaves(x0, x_step, x_turns, at_left), leaves(y0, y_step, y_turns, at_top));
        IntLanes end = least(last, at_word * WORD + (WORD - 1));
        end = leaving < real(end) ? most(l, truncated(leaving)) : end;
        const IntLanes before = ~(whole(-1) << (l & 31)), within = ~(whole(-2) << (end & 31));
        left = pick(searching, at_left, left), top = pick(searching, at_top, top);
        word = pick(searching, at_word, word), exit = pick(searching, end, exit);
        ahead = pick(searching, planes & ~before & within, ahead);
        brick = pick(searching, first + ones(planes & before) - 1, brick);
    }

    static IntLanes tile(Lanes texel, int32_t tiles) {
        return least(most(truncated(texel * (1.0f / CELLS)), IntLanes{}), whole(tiles - 1));
    }

    // Plane at which rays have left a tile along one axis; a ray parallel to it never does.
    static Lanes leaves(Lanes start, Lanes step, Lanes turns, IntLanes lower) {
        const Lanes end = real(lower + (step > 0 ? whole(CELLS) : IntLanes{}));
        return step == 0 ? splat(std::numeric_limits<float>::infinity()) : (end - start) * turns;
    }
};

} // namespace
