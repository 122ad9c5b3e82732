// Sixteen numbers at once, in registers of the processor's width, and the functions of them that the kernels need.
#pragma once
#include <cmath>
#include <cstdint>
#ifdef __AVX2__
#include <immintrin.h>
#endif

constexpr int WIDTH = 16;
// Of GCC's and Clang's vectors: GCC compares and chooses among the numbers of a wider one one by one.
#if defined(__AVX512F__)
constexpr int NATIVE = 16;
#elif defined(__AVX2__)
constexpr int NATIVE = 8;
#else
constexpr int NATIVE = 4;
#endif
constexpr int PIECES = WIDTH / NATIVE;

typedef float FloatPiece __attribute__((vector_size(4 * NATIVE)));
typedef int32_t IntPiece __attribute__((vector_size(4 * NATIVE)));

template <typename Number, typename Piece> struct Vector {
    Piece pieces[PIECES];

    Vector() : pieces{} {}

    Vector(Number x) {
        for (Piece& piece : pieces) piece = x - Piece{};
    }

    // One function of the pieces of some vectors.
    template <typename F, typename... Others> static Vector of(F f, const Others&... others) {
        Vector made;
        for (int i = 0; i < PIECES; i++) made.pieces[i] = f(others.pieces[i]...);
        return made;
    }

    typedef Number __attribute__((may_alias)) Element;
    Element& operator[](int64_t i) { return reinterpret_cast<Element*>(pieces)[i]; }
    const Element& operator[](int64_t i) const { return reinterpret_cast<const Element*>(pieces)[i]; }

    Vector operator-() const {
        return of([](Piece a) { return -a; }, *this);
    }
    Vector operator~() const {
        return of([](Piece a) { return ~a; }, *this);
    }
};

typedef Vector<float, FloatPiece> Lanes;
typedef Vector<int32_t, IntPiece> IntLanes;
typedef IntLanes Mask; // of lanes where a condition holds, which are ~0; others are 0

#define OPERATOR(KIND, PIECE, SIGN)                                                                                    \
    inline KIND operator SIGN(KIND a, KIND b) {                                                                        \
        return KIND::of([](PIECE x, PIECE y) { return x SIGN y; }, a, b);                                              \
    }                                                                                                                  \
    inline KIND& operator SIGN##=(KIND& a, KIND b) { return a = a SIGN b; }
#define FLOAT_OPERATOR(SIGN) OPERATOR(Lanes, FloatPiece, SIGN)
#define INT_OPERATOR(SIGN) OPERATOR(IntLanes, IntPiece, SIGN)
#define COMPARISON(KIND, PIECE, SIGN)                                                                                  \
    inline Mask operator SIGN(KIND a, KIND b) {                                                                        \
        return Mask::of([](PIECE x, PIECE y) { return IntPiece(x SIGN y); }, a, b);                                    \
    }
#define COMPARISONS(SIGN) COMPARISON(Lanes, FloatPiece, SIGN) COMPARISON(IntLanes, IntPiece, SIGN)

FLOAT_OPERATOR(+)
FLOAT_OPERATOR(-)
FLOAT_OPERATOR(*)
FLOAT_OPERATOR(/)
INT_OPERATOR(+)
INT_OPERATOR(-)
INT_OPERATOR(*)
INT_OPERATOR(&)
INT_OPERATOR(|)
INT_OPERATOR(^)
INT_OPERATOR(<<)
INT_OPERATOR(>>)
COMPARISONS(<)
COMPARISONS(<=)
COMPARISONS(>)
COMPARISONS(>=)
COMPARISONS(==)
COMPARISONS(!=)

inline Lanes splat(float x) { return x; }
inline IntLanes whole(int32_t x) { return x; }

inline Lanes pick(Mask where, Lanes a, Lanes b) {
    return Lanes::of([](IntPiece w, FloatPiece x, FloatPiece y) { return w ? x : y; }, where, a, b);
}
inline IntLanes pick(Mask where, IntLanes a, IntLanes b) {
    return IntLanes::of([](IntPiece w, IntPiece x, IntPiece y) { return w ? x : y; }, where, a, b);
}
inline Lanes least(Lanes a, Lanes b) { return pick(a < b, a, b); }
inline Lanes most(Lanes a, Lanes b) { return pick(a > b, a, b); }
inline IntLanes least(IntLanes a, IntLanes b) { return pick(a < b, a, b); }
inline IntLanes most(IntLanes a, IntLanes b) { return pick(a > b, a, b); }
inline Lanes magnitude(Lanes x) { return most(x, -x); }

inline Lanes real(IntLanes x) {
    return Lanes::of([](IntPiece a) { return __builtin_convertvector(a, FloatPiece); }, x);
}
// Towards zero.
inline IntLanes truncated(Lanes x) {
    return IntLanes::of([](FloatPiece a) { return __builtin_convertvector(a, IntPiece); }, x);
}
// The same bits.
inline Lanes as_float(IntLanes x) {
    return Lanes::of([](IntPiece a) { return FloatPiece(a); }, x);
}
inline IntLanes as_int(Lanes x) {
    return IntLanes::of([](FloatPiece a) { return IntPiece(a); }, x);
}

// A bit for each lane.
inline uint32_t bits(Mask where) {
    uint32_t all = 0;
    for (int i = 0; i < PIECES; i++) {
#if defined(__AVX512F__)
        all = _mm512_test_epi32_mask(__m512i(where.pieces[i]), __m512i(where.pieces[i]));
#elif defined(__AVX2__)
        all |= uint32_t(_mm256_movemask_ps(__m256(where.pieces[i]))) << NATIVE * i;
#else
        for (int k = 0; k < NATIVE; k++) all |= uint32_t(where.pieces[i][k] & 1) << (NATIVE * i + k);
#endif
    }
    return all;
}

inline bool any(Mask where) { return bits(where); }

inline float largest(Lanes x) {
    FloatPiece high = x.pieces[0];
    for (int i = 1; i < PIECES; i++) high = x.pieces[i] > high ? x.pieces[i] : high;
#ifdef __AVX512F__
    return _mm512_reduce_max_ps(__m512(high));
#endif
    float highest = high[0];
    for (int i = 1; i < NATIVE; i++) highest = high[i] > highest ? high[i] : highest;
    return highest;
}

inline Lanes load(const float* from) {
    Lanes x;
    for (int i = 0; i < PIECES; i++) __builtin_memcpy(&x.pieces[i], from + NATIVE * i, sizeof(FloatPiece));
    return x;
}

inline void store(float* to, Lanes x) {
    for (int i = 0; i < PIECES; i++) __builtin_memcpy(to + NATIVE * i, &x.pieces[i], sizeof(FloatPiece));
}
inline void store(int32_t* to, IntLanes x) {
    for (int i = 0; i < PIECES; i++) __builtin_memcpy(to + NATIVE * i, &x.pieces[i], sizeof(IntPiece));
}

// 0, 1, 2, ... up to `count`, and again from there.
inline Lanes counted(int count = WIDTH) {
    float numbers[WIDTH];
    for (int i = 0; i < WIDTH; i++) numbers[i] = float(i % count);
    return load(numbers);
}

const Lanes IOTA = counted(), EIGHT_TWICE = counted(8);

// Values of a function of each lane's number.
template <typename To, typename F> inline To each_lane(IntLanes x, F f) {
    int32_t from[WIDTH];
    decltype(f(from[0])) to[WIDTH];
    static_assert(sizeof to == sizeof(To), "sixteen numbers of four bytes");
    store(from, x);
    for (int i = 0; i < WIDTH; i++) to[i] = f(from[i]);
    To made;
    __builtin_memcpy(&made, to, sizeof made);
    return made;
}

// Sixteen numbers of a table.
inline IntLanes gather(const int32_t* table, IntLanes at) {
#ifdef __AVX512F__
    return IntLanes::of([table](IntPiece a) { return IntPiece(_mm512_i32gather_epi32(__m512i(a), table, 4)); }, at);
#endif
    return each_lane<IntLanes>(at, [table](int32_t i) { return table[i]; });
}

inline Lanes gather(const float* table, IntLanes at) {
#ifdef __AVX512F__
    return Lanes::of([table](IntPiece a) { return FloatPiece(_mm512_i32gather_ps(__m512i(a), table, 4)); }, at);
#endif
    return each_lane<Lanes>(at, [table](int32_t i) { return table[i]; });
}

typedef uint8_t ByteLanes __attribute__((vector_size(WIDTH)));

// By way of 16 bits: GCC 12 takes bytes apart one by one to make wider numbers of them.
inline IntLanes widened(ByteLanes codes) {
    typedef uint16_t ShortLanes __attribute__((vector_size(2 * WIDTH)));
    typedef uint16_t ShortPiece __attribute__((vector_size(2 * NATIVE)));
    const ShortLanes shorts = __builtin_convertvector(codes, ShortLanes);
    ShortPiece parts[PIECES];
    __builtin_memcpy(parts, &shorts, sizeof shorts);
    IntLanes x;
    for (int i = 0; i < PIECES; i++) x.pieces[i] = __builtin_convertvector(parts[i], IntPiece);
    return x;
}

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
    const IntLanes power = (truncated(n) + 127) << 23;
    return (p * r * r + r + 1.0f) * as_float(power);
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

// 1 - e^-x for x >= 0, exact also where it is small. NaN stays NaN.
inline Lanes absorbed(Lanes x) {
    Lanes p = splat(1.0f / 40320);
    p = p * x - 1.0f / 5040;
    p = p * x + 1.0f / 720;
    p = p * x - 1.0f / 120;
    p = p * x + 1.0f / 24;
    p = p * x - 1.0f / 6;
    p = p * x + 0.5f;
    return pick(x > 0.25f, 1.0f - exp_lanes(-x), x - x * x * p);
}
