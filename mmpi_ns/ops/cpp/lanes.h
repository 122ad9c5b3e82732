// Sixteen floats at once (GCC's and Clang's vector extension), and the functions of them that the kernels need.
#pragma once
#include <cmath>
#include <cstdint>
#ifdef __AVX512F__
#include <immintrin.h>
#endif

typedef float Lanes __attribute__((vector_size(64)));
typedef int32_t IntLanes __attribute__((vector_size(64)));
constexpr int WIDTH = 16;
const Lanes IOTA = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

const Lanes EIGHT_TWICE = {0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3, 4, 5, 6, 7};

inline Lanes splat(float x) { return x - Lanes{}; }
inline Lanes least(Lanes a, Lanes b) { return a < b ? a : b; }
inline Lanes most(Lanes a, Lanes b) { return a > b ? a : b; }
inline Lanes magnitude(Lanes x) { return most(x, -x); }

// Conditions of lanes are masks: ~0 where they hold, else 0.
typedef IntLanes Mask;

inline IntLanes whole(int32_t x) { return x - IntLanes{}; }
inline IntLanes least(IntLanes a, IntLanes b) { return a < b ? a : b; }
inline IntLanes most(IntLanes a, IntLanes b) { return a > b ? a : b; }
inline Lanes pick(Mask where, Lanes a, Lanes b) { return where ? a : b; }
inline IntLanes pick(Mask where, IntLanes a, IntLanes b) { return where ? a : b; }
inline Lanes real(IntLanes x) { return __builtin_convertvector(x, Lanes); }
inline IntLanes truncated(Lanes x) { return __builtin_convertvector(x, IntLanes); } // towards zero

// A bit for each lane.
inline uint32_t bits(Mask where) {
#ifdef __AVX512F__
    return _mm512_test_epi32_mask(__m512i(where), __m512i(where));
#endif
    where &= IntLanes{1,      1 << 1, 1 << 2,  1 << 3,  1 << 4,  1 << 5,  1 << 6,  1 << 7,
                      1 << 8, 1 << 9, 1 << 10, 1 << 11, 1 << 12, 1 << 13, 1 << 14, 1 << 15};
    int32_t each[WIDTH], all = 0;
    __builtin_memcpy(each, &where, sizeof each);
    for (int i = 0; i < WIDTH; i++) all |= each[i];
    return uint32_t(all);
}

inline bool any(Mask where) { return bits(where); }

inline float largest(Lanes x) {
#ifdef __AVX512F__
    return _mm512_reduce_max_ps(__m512(x));
#endif
    float each[WIDTH];
    __builtin_memcpy(each, &x, sizeof each);
    float highest = each[0];
    for (int i = 1; i < WIDTH; i++) highest = each[i] > highest ? each[i] : highest;
    return highest;
}

// Values of a function of each lane's number.
template <typename To, typename F> inline To each_lane(IntLanes x, F f) {
    int32_t from[WIDTH];
    decltype(f(from[0])) to[WIDTH];
    static_assert(sizeof to == sizeof(To), "sixteen numbers of four bytes");
    __builtin_memcpy(from, &x, sizeof from);
    for (int i = 0; i < WIDTH; i++) to[i] = f(from[i]);
    To made;
    __builtin_memcpy(&made, to, sizeof made);
    return made;
}

inline Lanes load(const float* from) {
    Lanes x;
    __builtin_memcpy(&x, from, sizeof x);
    return x;
}

// Sixteen numbers of a table.
inline IntLanes gather(const int32_t* table, IntLanes at) {
#ifdef __AVX512F__
    return IntLanes(_mm512_i32gather_epi32(__m512i(at), table, sizeof *table));
#endif
    return each_lane<IntLanes>(at, [table](int32_t i) { return table[i]; });
}

inline Lanes gather(const float* table, IntLanes at) {
#ifdef __AVX512F__
    return Lanes(_mm512_i32gather_ps(__m512i(at), table, sizeof *table));
#endif
    return each_lane<Lanes>(at, [table](int32_t i) { return table[i]; });
}

inline void store(float* to, Lanes x) { __builtin_memcpy(to, &x, sizeof x); }
inline void store(int32_t* to, IntLanes x) { __builtin_memcpy(to, &x, sizeof x); }

typedef uint8_t ByteLanes __attribute__((vector_size(WIDTH)));

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
