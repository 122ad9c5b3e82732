// By how much the colours of an image differ from those of others at given depths: bytes, many at a time.
#include "lanes.h"
#include "parts.h"

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <vector>

namespace {

constexpr int CLEARLY = 80, REACH = 2, SIDE = 2 * REACH + 1, SAME = 12, APART = 2, CHANNELS = 4; // as in __init__.py
constexpr float OCCLUDES = 1.15f, LEAST_AHEAD = 1e-6f;
constexpr uint8_t ALL = 255;

// Mirrored about the first and the last of some rows or columns.
int64_t mirrored(int64_t at, int64_t size) {
    const int64_t last = size - 1;
    return std::min(last, std::abs(last - std::abs(last - std::abs(at))));
}

int64_t next_to(int64_t at, int64_t size) { return std::clamp<int64_t>(at, 0, size - 1); }

// What another image shows of an image's pixels at their depths.
struct Seen {
    std::vector<int32_t> colors;
    std::vector<uint8_t> shown, free, apart;

    Seen(const float* inverse, int64_t height, int64_t width, const int32_t* layer, const float* around, int64_t rows,
         int64_t columns, const float* linear, const float* b, bool pairs)
        : colors(height * width), shown(height * width), free(pairs * height * width), apart(height * width) {
        const auto within = [](Lanes x, int64_t size) {
            return truncated(least(most(x + 0.5f, Lanes{}), splat(float(size - 1)))); // at halves it does not matter
        };
        for (int64_t row = 0; row < height; row++)
            for (int64_t column = 0, i = row * width; column < width; column += WIDTH, i += WIDTH) {
                const int64_t count = width - column;
                const Lanes q = load_some<Lanes>(inverse + i, count);
                Lanes at[3];
                for (int n = 0; n < 3; n++) {
                    const float start = linear[3 * n + 1] * (row + 0.5f) + linear[3 * n + 2];
                    at[n] = linear[3 * n] * (IOTA + (column + 0.5f)) + start + q * b[n];
                }
                const Lanes over = reciprocal(pick(at[2] > LEAST_AHEAD, at[2], splat(1)));
                const IntLanes place = within(at[1] * over - 0.5f, rows) * int32_t(columns) +
                                       within(at[0] * over - 0.5f, columns);
                // The first pixel shows nothing.
                const IntLanes color = gather(layer, pick(at[2] > LEAST_AHEAD, place, whole(0)));
                const IntLanes is_shown = color >> 24 & 1;
                store_some(&colors[i], color, count);
                put_bytes(&shown[i], is_shown, count);
                if (!pairs) continue;
                const IntLanes bits = gather(reinterpret_cast<const int32_t*>(around), place);
                Lanes theirs;
                std::memcpy(&theirs, &bits, sizeof bits);
                theirs *= at[2];
                const Lanes room = least(theirs * OCCLUDES - q, OCCLUDES * q - theirs);
                put_bytes(&free[i], pick(room >= 0, is_shown, whole(0)), count);
            }
    }

    static void put_bytes(uint8_t* to, IntLanes x, int64_t count) {
        store_some(to, __builtin_convertvector(x, ByteLanes), count);
    }
};

// The largest of three channels of how far colours lie outside the range of those of nine pixels.
void outside_row(const uint8_t* __restrict above, const uint8_t* __restrict middle, const uint8_t* __restrict below,
                 const uint8_t* __restrict color, uint8_t* __restrict low, uint8_t* __restrict high,
                 uint8_t* __restrict bytes, uint8_t* __restrict apart, int64_t width) {
    const int64_t count = CHANNELS * width;
    for (int64_t i = 0; i < count; i++) {
        low[CHANNELS + i] = std::min(std::min(above[i], middle[i]), below[i]);
        high[CHANNELS + i] = std::max(std::max(above[i], middle[i]), below[i]);
    }
    for (uint8_t* edge : {low, high}) { // beyond the border as at it
        std::memcpy(edge, edge + CHANNELS, CHANNELS);
        std::memcpy(edge + CHANNELS + count, edge + count, CHANNELS);
    }
    for (int64_t i = 0; i < count; i++) {
        const uint8_t least = std::min(std::min(low[i], low[i + CHANNELS]), low[i + 2 * CHANNELS]);
        const uint8_t most = std::max(std::max(high[i], high[i + CHANNELS]), high[i + 2 * CHANNELS]);
        const uint8_t under = std::max(least, color[i]) - color[i], over = color[i] - std::min(most, color[i]);
        bytes[i] = std::max(under, over);
    }
    for (int64_t x = 0; x < width; x++) {
        const uint8_t *at = bytes + CHANNELS * x, largest = std::max(std::max(at[0], at[1]), at[2]);
        apart[x] = std::min<uint8_t>(largest, CLEARLY);
    }
}

// Means of windows, ALL where nothing is shown.
void average(const uint8_t* apart, const uint8_t* shown, int64_t height, int64_t width, uint8_t* levels) {
    std::vector<uint16_t> columns(width + 2 * REACH);
    for (int64_t row = 0; row < height; row++) {
        const uint8_t* rows[SIDE];
        for (int n = 0; n < SIDE; n++) rows[n] = apart + mirrored(row + n - REACH, height) * width;
        uint16_t* __restrict sums = columns.data() + REACH;
        for (int64_t x = 0; x < width; x++) {
            uint16_t sum = 0;
            for (const uint8_t* each : rows) sum += each[x];
            sums[x] = sum;
        }
        for (int64_t n = 1; n <= REACH; n++) {
            sums[-n] = sums[mirrored(-n, width)];
            sums[width - 1 + n] = sums[mirrored(width - 1 + n, width)];
        }
        uint8_t* __restrict to = levels + row * width;
        const uint8_t* __restrict is_shown = shown + row * width;
        for (int64_t x = 0; x < width; x++) {
            const uint16_t sum = sums[x - 2] + sums[x - 1] + sums[x] + sums[x + 1] + sums[x + 2];
            const uint8_t mean = uint8_t(sum * (1.0f / (SIDE * SIDE)) + 0.5f);
            to[x] = is_shown[x] ? mean : ALL;
        }
    }
}

void mmpi_compare_colors(int64_t, int64_t, const int32_t* color, const float* inverse, const int32_t* layers,
                         const float* around, const int64_t* extents, const float* linear, const float* b, bool pairs,
                         int64_t height, int64_t width, int64_t, int64_t count, uint8_t* levels, uint8_t* pair,
                         bool* agreed) {
    const int64_t pixels = height * width, bytes = CHANNELS * (width + 2);
    std::vector<Seen> seen;
    std::vector<uint8_t> low(bytes), high(bytes), unlike(bytes);
    for (int64_t k = 0; k < count; k++) {
        const int64_t* extent = extents + 3 * k;
        Seen one(inverse, height, width, layers + extent[0], around + extent[0], extent[1], extent[2], linear + 9 * k,
                 b + 3 * k, pairs);
        const auto row_of = [&](const int32_t* image, int64_t row) {
            return reinterpret_cast<const uint8_t*>(image + next_to(row, height) * width);
        };
        for (int64_t row = 0; row < height; row++)
            outside_row(row_of(one.colors.data(), row - 1), row_of(one.colors.data(), row),
                        row_of(one.colors.data(), row + 1), row_of(color, row), low.data(), high.data(), unlike.data(),
                        &one.apart[row * width], width);
        average(one.apart.data(), one.shown.data(), height, width, levels + k * pixels);
        if (pairs) seen.push_back(std::move(one));
    }
    std::memset(pair, 0, pixels);
    std::memset(agreed, 0, pixels);
    for (int64_t a = 0; a < int64_t(seen.size()); a++)
        for (int64_t other = std::max<int64_t>(0, a - APART); other < a; other++) {
            const uint8_t* __restrict mine = reinterpret_cast<const uint8_t*>(seen[a].colors.data());
            const uint8_t* __restrict theirs = reinterpret_cast<const uint8_t*>(seen[other].colors.data());
            const uint8_t *__restrict free = seen[a].free.data(), *__restrict also_free = seen[other].free.data();
            const uint8_t *__restrict one = levels + a * pixels, *__restrict two = levels + other * pixels;
            uint8_t *__restrict apart = unlike.data(), *__restrict best = pair;
            uint8_t* __restrict both = reinterpret_cast<uint8_t*>(agreed);
            for (int64_t first = 0; first < pixels; first += width) {
                for (int64_t i = 0; i < CHANNELS * width; i++) {
                    const uint8_t x = mine[CHANNELS * first + i], y = theirs[CHANNELS * first + i];
                    apart[i] = std::max(x, y) - std::min(x, y);
                }
                for (int64_t x = 0, i = first; x < width; x++, i++) {
                    const uint8_t *at = apart + CHANNELS * x, largest = std::max(std::max(at[0], at[1]), at[2]);
                    const uint8_t agrees = free[i] & also_free[i] & uint8_t(largest < SAME);
                    both[i] |= agrees;
                    best[i] = std::max<uint8_t>(best[i], std::min(one[i], two[i]) & uint8_t(-agrees));
                }
            }
        }
}

} // namespace

IN_PARTS(mmpi_compare_colors)
