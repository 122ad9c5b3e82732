// Sixteen numbers, or the first of them, as rows of images end anywhere.
#pragma once
#include "lanes.h"

inline Lanes root(Lanes x) {
    float each[WIDTH];
    __builtin_memcpy(each, &x, sizeof each);
    for (float& number : each) number = std::sqrt(number);
    return load(each);
}

// Loads and stores of the first `count` of sixteen numbers; the others are 0.
template <typename To, typename From> inline To load_some(const From* from, int64_t count) {
    To x{};
    static_assert(sizeof x == WIDTH * sizeof *from, "sixteen numbers");
    if (count >= WIDTH)
        __builtin_memcpy(&x, from, sizeof x);
    else
        __builtin_memcpy(&x, from, count * sizeof *from);
    return x;
}

template <typename From, typename To> inline void store_some(To* to, const From& x, int64_t count) {
    static_assert(sizeof x == WIDTH * sizeof *to, "sixteen numbers");
    if (count >= WIDTH)
        __builtin_memcpy(to, &x, sizeof x);
    else
        __builtin_memcpy(to, &x, count * sizeof *to);
}
