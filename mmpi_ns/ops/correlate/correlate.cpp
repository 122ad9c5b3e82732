// How alike two images are around each pixel at one inverse depth: whole numbers but for the last division.
#include "lanes.h"
#include "parts.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace {

constexpr int REACH = 3, SIDE = 2 * REACH + 1, PIXELS = SIDE * SIDE, STEPS = 32; // as in __init__.py
constexpr float LEAST_AHEAD = 1e-6f;

// The nearest whole numbers; of less than 2^22.
Lanes rounded(Lanes x) { return (x + 12582912.0f) - 12582912.0f; }

// A row of an image as another one shows it, interpolated; 0 where that shows nothing.
void warp_row(const int32_t* corners, int64_t height, int64_t width, const float* linear, const float* b, float inverse,
              int64_t row, int64_t count, uint8_t* to) {
    float start[3];
    for (int i = 0; i < 3; i++) start[i] = linear[3 * i + 1] * (row + 0.5f) + linear[3 * i + 2] + inverse * b[i];
    for (int64_t column = 0; column < count; column += WIDTH) {
        const Lanes x = IOTA + (column + 0.5f), ahead = linear[6] * x + start[2];
        const Lanes over = reciprocal(pick(ahead > LEAST_AHEAD, ahead, splat(1)));
        const auto place = [&](int i) {
            const Lanes at = ((linear[3 * i] * x + start[i]) * over - 0.5f) * float(STEPS);
            return truncated(rounded(least(most(at, splat(-1e5f)), splat(1e5f))));
        };
        // The outermost corners are all of nothing.
        const auto within = [](IntLanes x, int64_t size) { return least(most(x, whole(0)), whole(int32_t(size - 1))); };
        const IntLanes across = place(0), down = place(1), left = within((across >> 5) + 2, width);
        const IntLanes at = within((down >> 5) + 2, height) * int32_t(width) + left;
        const IntLanes four = gather(corners, pick(ahead > LEAST_AHEAD, at, whole(0)));
        const Lanes u = real(across & (STEPS - 1)), v = real(down & (STEPS - 1));
        const Lanes one = real(four & 255), two = real(four >> 8 & 255);
        const Lanes three = real(four >> 16 & 255), last = real(four >> 24 & 255);
        const Lanes upper = one * float(STEPS) + u * (two - one), lower = three * float(STEPS) + u * (last - three);
        const Lanes value = (upper * float(STEPS) + v * (lower - upper)) * (1.0f / (STEPS * STEPS)) + 0.5f;
        store_some(to + column, __builtin_convertvector(truncated(value), ByteLanes), count - column);
    }
}

// Adds a row of gray levels there, their squares and products with those here to sums of columns, and takes one away.
void add_row(const uint8_t* __restrict theirs, const uint8_t* __restrict mine, const uint8_t* __restrict old_theirs,
             const uint8_t* __restrict old_mine, int32_t* __restrict sums, int64_t count) {
    int32_t *__restrict first = sums + REACH, *__restrict second = first + count + 2 * REACH;
    int32_t* __restrict third = second + count + 2 * REACH;
    for (int64_t x = 0; x < count; x++) {
        const uint16_t now = theirs[x], before = old_theirs[x];
        first[x] += now - before;
        second[x] += int32_t(uint16_t(now * now)) - int32_t(uint16_t(before * before));
        third[x] += int32_t(uint16_t(now * mine[x])) - int32_t(uint16_t(before * old_mine[x]));
    }
}

// Sums of seven neighbours each.
void add_seven(const int32_t* __restrict from, int32_t* __restrict to, int64_t count) {
    for (int64_t x = 0; x < count; x++)
        to[x] = from[x] + from[x + 1] + from[x + 2] + from[x + 3] + from[x + 4] + from[x + 5] + from[x + 6];
}

void correlate(const uint8_t* gray, const float* mean, const float* contrast, const int32_t* corners,
               int64_t their_height, int64_t their_width, const float* linear, const float* b, float inverse,
               int64_t height, int64_t width, float* alike) {
    std::vector<uint8_t> seen(height * width);
    for (int64_t row = 0; row < height; row++)
        warp_row(corners, their_height, their_width, linear, b, inverse, row, width, &seen[row * width]);
    // Sums of columns of seven pixels: of their gray levels, of their squares, and of products with those here.
    const int64_t padded = width + WIDTH;
    std::vector<int32_t> columns(3 * (width + 2 * REACH)), windows(3 * padded);
    const std::vector<uint8_t> nothing(width);
    const auto row_of = [&](const uint8_t* image, int64_t row) {
        return image + std::clamp<int64_t>(row, 0, height - 1) * width;
    };
    for (int64_t row = -REACH - 1; row < REACH; row++)
        add_row(row_of(seen.data(), row), row_of(gray, row), nothing.data(), nothing.data(), columns.data(), width);
    for (int64_t row = 0; row < height; row++) {
        add_row(row_of(seen.data(), row + REACH), row_of(gray, row + REACH), row_of(seen.data(), row - REACH - 1),
                row_of(gray, row - REACH - 1), columns.data(), width);
        for (int n = 0; n < 3; n++) {
            int32_t* sums = columns.data() + n * (width + 2 * REACH);
            std::fill(sums, sums + REACH, sums[REACH]);
            std::fill(sums + REACH + width, sums + width + 2 * REACH, sums[REACH + width - 1]);
            add_seven(sums, windows.data() + n * padded, width);
        }
        for (int64_t x = 0; x < width; x += WIDTH) {
            const int64_t i = row * width + x, count = width - x;
            IntLanes sums[3];
            for (int n = 0; n < 3; n++) sums[n] = load_some<IntLanes>(windows.data() + n * padded + x, WIDTH);
            const Lanes means = load_some<Lanes>(mean + i, count), contrasts = load_some<Lanes>(contrast + i, count);
            const IntLanes here = __builtin_convertvector(load_some<ByteLanes>(&seen[i], count), IntLanes);
            const Lanes squares = most(real(PIXELS * sums[1] - sums[0] * sums[0]), splat(PIXELS * PIXELS));
            const Lanes common = real(PIXELS * sums[2] - truncated(means * float(PIXELS) + 0.5f) * sums[0]);
            const Lanes both = inverse_root(squares) * reciprocal(most(contrasts, splat(1)) * float(PIXELS));
            store_some(alike + i, pick(here > 0, common * both, splat(-1)), count);
        }
    }
}

// Images [begin, end) of those that an image is compared with.
void mmpi_correlate_at(int64_t begin, int64_t end, const uint8_t* gray, const float* mean, const float* contrast,
                       const int32_t* corners, const int64_t* sizes, const float* linear, const float* b, float inverse,
                       int64_t height, int64_t width, int64_t, int64_t, float* alike) {
    for (int64_t k = begin; k < end; k++)
        correlate(gray, mean, contrast, corners + sizes[3 * k], sizes[3 * k + 1], sizes[3 * k + 2], linear + 9 * k,
                  b + 3 * k, inverse, height, width, alike + k * height * width);
}

} // namespace

IN_PARTS(mmpi_correlate_at)
