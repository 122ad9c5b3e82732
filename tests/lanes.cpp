// Functions of lanes, for tests/ops/test_lanes.py.
#include "lanes.h"

extern "C" {

int width_of_registers() { return NATIVE; }

// Of sixteen numbers x and y: ten results of sixteen numbers each.
void try_lanes(const float* x, const float* y, const uint8_t* codes, float* to) {
    const Lanes a = load(x), b = load(y);
    ByteLanes bytes;
    __builtin_memcpy(&bytes, codes, sizeof bytes);
    const IntLanes whole_a = truncated(a), table = widened(bytes);
    int32_t numbers[WIDTH];
    store(numbers, table);
    Lanes changed = 2 - a / 3 * b;
    changed[3] = changed[12] + 1;
    const Lanes results[] = {
        exp_lanes(a),
        softplus_lanes(a),
        pick((a < b) & (b != 0), least(a, b) - 1, most(a, -b)),
        real(((whole_a << 2) + (whole_a >> 1)) ^ (whole_a & 7) | ~whole_a),
        real(gather(numbers, truncated(IOTA) ^ 5)),
        gather(x, (truncated(EIGHT_TWICE) * 3) & 15),
        as_float(as_int(a) & 0x7fffffff),
        splat(largest(a)) + float(any(a > 1e30f)),
        real(IntLanes(int32_t(bits(a >= b)))),
        changed,
    };
    for (const Lanes& result : results) store(to, result), to += WIDTH;
}
}
