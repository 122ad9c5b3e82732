// Sixteen floats at once (GCC's and Clang's vector extension), and the functions of them that the kernels need.
#pragma once
#include <cstdint>

typedef float Lanes __attribute__((vector_size(64)));
typedef int32_t IntLanes __attribute__((vector_size(64)));
constexpr int WIDTH = 16;
const Lanes IOTA = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

inline Lanes splat(float x) { return x - Lanes{}; }
inline Lanes least(Lanes a, Lanes b) { return a < b ? a : b; }
inline Lanes most(Lanes a, Lanes b) { return a > b ? a : b; }
inline Lanes magnitude(Lanes x) { return most(x, -x); }

inline Lanes load(const float* from) {
    Lanes x;
    __builtin_memcpy(&x, from, sizeof x);
    return x;
}

inline void store(float* to, Lanes x) { __builtin_memcpy(to, &x, sizeof x); }

// e^x to 2 ulp for x in [-87, 88], clamped there (Cephes' expf).
inline Lanes exp_lanes(Lanes x) {
    x = least(most(x, splat(-87)), splat(88));
    const Lanes magic = splat(12582912.0f); // 1.5 * 2^23: adding it rounds to an integer
    const Lanes n = (x * 1.44269504f + magic) - magic;
    const Lanes r = x - n * 0.693359375f + n * 2.12194440e-4f;
    Lanes p = splat(1.9875691500e-4f);
    p = p * r + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 5.0000001201e-1f;
    const IntLanes power = (__builtin_convertvector(n, IntLanes) + 127) << 23;
    return (p * r * r + r + 1.0f) * (Lanes)power;
}

// log(1 + e^x) to a few ulp: max(x, 0) + 2 atanh(y / (2 + y)) with y = e^-|x|.
inline Lanes softplus_lanes(Lanes x) {
    const Lanes y = exp_lanes(-magnitude(x)), z = y / (2.0f + y), q = z * z; // q <= 1/9
    Lanes p = splat(1.0f / 15);
    p = p * q + 1.0f / 13;
    p = p * q + 1.0f / 11;
    p = p * q + 1.0f / 9;
    p = p * q + 1.0f / 7;
    p = p * q + 1.0f / 5;
    p = p * q + 1.0f / 3;
    p = p * q + 1.0f;
    return most(x, Lanes{}) + 2.0f * z * p;
}

// sin(pi x) for |x| <= 1/2 (its Taylor series: 6e-8 at the ends).
inline Lanes sin_half_turn(Lanes x) {
    const Lanes z = x * 3.14159265f, q = z * z;
    Lanes p = splat(-1.0f / 39916800);
    p = p * q + 1.0f / 362880;
    p = p * q - 1.0f / 5040;
    p = p * q + 1.0f / 120;
    p = p * q - 1.0f / 6;
    return z + z * q * p;
}

// sin(pi x) and cos(pi x) for |x| <= 1.
inline void sincos_turn(Lanes x, Lanes& sine, Lanes& cosine) {
    const Lanes size = magnitude(x), folded = least(size, 1.0f - size);
    const Lanes s = sin_half_turn(folded);
    sine = x < 0 ? -s : s;
    cosine = sin_half_turn(0.5f - size);
}
