// A table of rows of numbers, of which sixteen are read at once.
//
// Rows of eight numbers, which the tables of features have by default, are half a cache line: they are read, written and
// added to whole, without a loop over channels.
#pragma once
#include "lanes.h"

constexpr int64_t AHEAD = 32; // rows that are prefetched

template <typename T> inline void prefetch_row(const T* row, int64_t channels) {
    const char* end = reinterpret_cast<const char*>(row + channels);
    for (const char* line = reinterpret_cast<const char*>(row); line < end; line += 64) __builtin_prefetch(line);
}

constexpr int64_t OCTET = 8;
typedef float Octet __attribute__((vector_size(32)));

inline Octet load_octet(const float* from) {
    Octet x;
    __builtin_memcpy(&x, from, sizeof x);
    return x;
}

inline Lanes join(Octet a, Octet b) {
    Lanes x;
#ifdef __AVX512F__ // by way of memory, the load would wait for both stores
    const __m512d lower = _mm512_castpd256_pd512(__m256d(a));
    x.pieces[0] = FloatPiece(_mm512_insertf64x4(lower, __m256d(b), 1));
    return x;
#endif
    __builtin_memcpy(x.pieces, &a, sizeof a), __builtin_memcpy(reinterpret_cast<char*>(x.pieces) + sizeof a, &b, sizeof b);
    return x;
}

inline Octet half_of(const Lanes& x, int which) {
    Octet half;
    __builtin_memcpy(&half, reinterpret_cast<const char*>(x.pieces) + which * sizeof half, sizeof half);
    return half;
}
inline Octet lower_half(Lanes x) { return half_of(x, 0); }
inline Octet upper_half(Lanes x) { return half_of(x, 1); }

// to += share * from.
inline void add_row(float* to, const float* from, float share, int64_t channels) {
    if (channels == OCTET) {
        const Octet sum = load_octet(to) + share * load_octet(from);
        __builtin_memcpy(to, &sum, sizeof sum);
    } else
        for (int64_t c = 0; c < channels; c++) to[c] += share * from[c];
}

struct Table {
    const float* numbers;
    int64_t rows, channels;

    void prefetch(int64_t row) const {
        __builtin_prefetch(numbers + row * channels);
        __builtin_prefetch(numbers + (row + 1) * channels - 1);
    }

    // A row of eight numbers.
    Octet octet(int64_t row) const { return load_octet(numbers + row * OCTET); }

    // Sixteen numbers from `at` on; those beyond the table are 0.
    Lanes read(int64_t at) const {
        if (at + WIDTH <= rows * channels) return load(numbers + at);
        Lanes x{};
        for (int64_t i = 0; at + i < rows * channels; i++) x[i] = numbers[at + i];
        return x;
    }
};
