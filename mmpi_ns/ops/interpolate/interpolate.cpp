// Rows of tables that a batch reads: their numbers, values and gradients.
#include "parts.h"
#include "taps.h"

namespace {

// Distinct values of `rows`, none negative, in four steps, each in parts by several threads. Every brick has a word of
// 64 bits, all 0 before the first step; of bricks without a row only the word is read.

// Sets the bits of rows [begin, end) of a list.
void mmpi_mark_rows(int64_t begin, int64_t end, const int64_t* rows, uint64_t* words) {
    for (int64_t i = begin; i < end; i++) {
        uint64_t* word = words + (rows[i] >> 6);
        const uint64_t bit = uint64_t(1) << (rows[i] & 63);
        if (!(__atomic_load_n(word, __ATOMIC_RELAXED) & bit)) __atomic_fetch_or(word, bit, __ATOMIC_RELAXED);
    }
}

// Number of marked rows in bricks [begin, end), to the part's place in `counts`.
void mmpi_count_rows(int64_t begin, int64_t end, const uint64_t* words, int64_t* counts) {
    int64_t count = 0;
    for (int64_t b = begin; b < end; b++) count += __builtin_popcountll(words[b]);
    counts[this_part] = count;
}

// Lists the marked rows of bricks [begin, end) from the part's place in `starts` on; `before` [bricks] is the number of
// marked rows in front of a brick.
void mmpi_list_rows(int64_t begin, int64_t end, const uint64_t* words, const int64_t* starts, int32_t* before,
                    int64_t* unique) {
    int64_t at = starts[this_part];
    for (int64_t b = begin; b < end; b++) {
        if (words[b]) before[b] = int32_t(at);
        for (uint64_t left = words[b]; left; left &= left - 1) unique[at++] = b * BRICK + __builtin_ctzll(left);
    }
}

// Places of rows [begin, end) among the marked ones.
void mmpi_place_rows(int64_t begin, int64_t end, const int64_t* rows, const uint64_t* words, const int32_t* before,
                     int32_t* positions) {
    for (int64_t i = begin; i < end; i++) {
        const uint64_t earlier = words[rows[i] >> 6] & ((uint64_t(1) << (rows[i] & 63)) - 1);
        positions[i] = before[rows[i] >> 6] + int32_t(__builtin_popcountll(earlier));
    }
}

// table[rows] at entries [begin, end).
void mmpi_chosen_rows(int64_t begin, int64_t end, const float* table, const int64_t* rows, int64_t, int64_t channels,
                      int64_t, float* values) {
    for (int64_t i = begin; i < end; i++) {
        if (i + AHEAD < end) prefetch_row(table + rows[i + AHEAD] * channels, channels);
        std::copy_n(table + rows[i] * channels, channels, values + i * channels);
    }
}

// The sum of weights[n, b] * table[positions[n, b]] over b, of samples [begin, end).
void mmpi_weighted_rows(int64_t begin, int64_t end, const float* numbers, const int32_t* positions,
                        const float* weights, int64_t rows, int64_t channels, int64_t, int64_t taps, float* values) {
    const Table table{numbers, rows, channels};
    const int64_t ahead = AHEAD / taps;
    for (int64_t n = begin; n < end; n++) {
        for (int64_t i = (n + ahead) * taps; n + ahead < end && i < (n + ahead + 1) * taps; i++) table.prefetch(positions[i]);
        if (channels == 1) { // densities, reliabilities
            float sum = 0;
            for (int64_t i = n * taps; i < (n + 1) * taps; i++) sum += weights[i] * numbers[positions[i]];
            values[n] = sum;
            continue;
        }
        for (int64_t first = 0; first < channels; first += WIDTH) {
            Lanes sum{};
            for (int64_t i = n * taps; i < (n + 1) * taps; i++)
                sum += weights[i] * table.read(positions[i] * channels + first);
            for (int64_t c = first; c < std::min(channels, first + WIDTH); c++) values[n * channels + c] = sum[c - first];
        }
    }
}

// values[positions[n, b]] is the sum of weights[n, b] * grad[n], of the entries at positions [begin, end). One
// thread owns a position and adds in the order of samples.
void mmpi_sum_rows(int64_t begin, int64_t end, const int32_t* positions, const float* weights, const float* grad,
                   int64_t samples, int64_t taps, int64_t channels, float* values) {
    std::fill(values + begin * channels, values + end * channels, 0.0f);
    for (int64_t i = 0; i < samples * taps; i++) {
        if (i + AHEAD < samples * taps) prefetch_row(values + positions[i + AHEAD] * channels, channels);
        if (begin <= positions[i] && positions[i] < end)
            add_row(values + positions[i] * channels, grad + i / taps * channels, weights[i], channels);
    }
}

// Rows and weights of the texels around samples [begin, end); of eight `taps`, the last four of a sample on a plane are
// the first ones again, with weight 0.
void mmpi_texel_rows(int64_t begin, int64_t end, const Grid* grids, int64_t num_mpis, int64_t taps,
                     const int64_t* heads, const int64_t* planes, const float* ndc, int64_t* rows, float* weights) {
    for (int64_t i = begin; i < end; i++) {
        Sample sample;
        sample.put(grids[heads[i]], heads[i] == num_mpis, planes[i], ndc + 3 * i);
        for (int tap = 0; tap < taps; tap++) {
            const bool is_own = tap < sample.taps;
            rows[taps * i + tap] = sample.rows[is_own ? tap : tap - 4];
            weights[taps * i + tap] = is_own ? sample.shares[tap] : 0;
        }
    }
}

} // namespace

IN_PARTS(mmpi_mark_rows)
IN_PARTS(mmpi_count_rows)
IN_PARTS(mmpi_list_rows)
IN_PARTS(mmpi_place_rows)
IN_PARTS(mmpi_chosen_rows)
IN_PARTS(mmpi_weighted_rows)
IN_PARTS(mmpi_sum_rows)
IN_PARTS(mmpi_texel_rows)
