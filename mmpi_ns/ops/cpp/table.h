// A table of rows of numbers, of which sixteen are read at once.
#pragma once
#include "lanes.h"

constexpr int64_t AHEAD = 8; // rows whose cache lines are asked for before they are needed

template <typename T> inline void prefetch_row(const T* row, int64_t channels) {
    const char* end = reinterpret_cast<const char*>(row + channels);
    for (const char* line = reinterpret_cast<const char*>(row); line < end; line += 64) __builtin_prefetch(line);
}

struct Table {
    const float* numbers;
    int64_t rows, channels;

    void prefetch(int64_t row) const {
        __builtin_prefetch(numbers + row * channels);
        __builtin_prefetch(numbers + (row + 1) * channels - 1);
    }

    // Sixteen numbers from `at` on; those beyond the table are 0.
    Lanes read(int64_t at) const {
        if (at + WIDTH <= rows * channels) return load(numbers + at);
        Lanes x{};
        for (int64_t i = 0; at + i < rows * channels; i++) x[i] = numbers[at + i];
        return x;
    }
};
