// Sixteen rays on their way through a multi-plane image, each from one plane that holds something to the next. Columns
// say which planes do (scene/baked.py); a tile is CELLS x CELLS cells (squares between four texels) of a plane.
#pragma once
#include "lanes.h"

#include <limits>

namespace {

constexpr int WORD = 32;

struct Column {
    int32_t planes; // a bit each
    int32_t first;  // brick of the lowest bit; the others follow it
};

// The planes of one MPI.
struct Stack {
    float step, end; // disparity between planes and of the last one
    int32_t planes, height, width, down, across;
    int32_t first_column;
};

inline IntLanes ones(IntLanes x) {
    return each_lane<IntLanes>(x, [](int32_t word) { return int32_t(__builtin_popcount(uint32_t(word))); });
}

// Planes are counted from the nearest one. What lanes hold whose rays are over is not used.
template <int CELLS> struct Walks {
    Lanes x_last, x_step, x_turns, y_last, y_step, y_turns; // texel on the last plane, from plane to plane; turns: 1 / step
    Lanes oz, dz;
    Lanes inverse_t;    // of the sample at hand; -1 where there is none
    IntLanes left, top; // of the tile, texels
    IntLanes exit, last, plane, brick, word;
    IntLanes ahead; // planes of the column that are still to come

    // Rays of `going` set out at planes `first`. Texels and axes are there already.
    void begin(const Column* columns, const Stack& stack, IntLanes first, Mask going) {
        x_turns = 1 / x_step, y_turns = 1 / y_step, exit = first - 1;
        inverse_t = splat(-1), left = top = plane = brick = word = ahead = IntLanes{};
        next(columns, stack, going & (first <= last));
    }

    // Rays of `going` go on to the next plane that holds something.
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

    // Looks up the columns that rays enter at planes l, and how far each goes in its own.
    void search(const Column* columns, const Stack& stack, IntLanes l, Mask searching) {
        const Lanes back = real(l - (stack.planes - 1));
        const IntLanes across = pick(searching, tile(x_last + back * x_step, stack.across), IntLanes{});
        const IntLanes down = pick(searching, tile(y_last + back * y_step, stack.down), IntLanes{});
        const IntLanes at_word = pick(searching, l >> 5, IntLanes{});
        const IntLanes place = stack.first_column + (at_word * stack.down + down) * stack.across + across;
        const IntLanes planes = each_lane<IntLanes>(place, [&](int32_t at) { return columns[at].planes; });
        const IntLanes first = each_lane<IntLanes>(place, [&](int32_t at) { return columns[at].first; });
        const IntLanes at_left = across * CELLS, at_top = down * CELLS;
        const Lanes leaving = float(stack.planes - 1) + least(leaves(x_last, x_step, x_turns, at_left),
                                                              leaves(y_last, y_step, y_turns, at_top));
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

    // Planes behind the last one at which rays leave a tile along one axis; a ray parallel to it never does.
    static Lanes leaves(Lanes last, Lanes step, Lanes turns, IntLanes lower) {
        const Lanes end = real(lower + (step > 0 ? whole(CELLS) : IntLanes{}));
        return step == 0 ? splat(std::numeric_limits<float>::infinity()) : (end - last) * turns;
    }
};

// The ray that is least far on its way goes first, with all that wait for the same head: so they stay abreast, and each
// meets its own samples in its own order. `next` tells the inverse distance of each ray's next sample in a head, -1 for
// none, `take` takes the samples of one head, `over` tells which rays are.
template <typename Next, typename Over, typename Take>
void walk_abreast(int32_t heads, const Next& next, const Over& over, const Take& take) {
    for (;;) {
        Lanes top = next(0);
        IntLanes best{};
        for (int32_t h = 1; h < heads; h++) { // ties: the first head
            best = next(h) > top ? whole(h) : best;
            top = most(next(h), top);
        }
        const Mask left = (top >= 0) & ~over();
        if (!any(left)) return;
        const Lanes waiting = pick(left, top, splat(-1));
        const int32_t h = best[__builtin_ctz(bits(waiting == largest(waiting)))];
        take(h, left & (best == h));
    }
}

} // namespace
