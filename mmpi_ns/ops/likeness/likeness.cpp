// How alike an image and others are at some inverse depths, by windows whose sums slide from row to row.
#include "lanes.h"
#include "parts.h"

#include <algorithm>
#include <cstdint>
#include <vector>

namespace {

constexpr int REACH = 3, SIDE = 2 * REACH + 1, PIXELS = SIDE * SIDE, STEPS = 32; // as in __init__.py

typedef std::vector<uint8_t> Bytes;

// Sums over the windows about the pixels of a row: of an image, of its squares, and of its products with another one.
class Windows {
    const Bytes &image, &by;
    const int64_t height, width, stride, length;
    std::vector<int32_t> columns;

    void add(int64_t row, int32_t sign) {
        const int64_t from = std::clamp<int64_t>(row, 0, height - 1) * stride;
        const uint8_t *x = image.data() + from, *y = by.data() + from;
        int32_t *sum = columns.data() + REACH, *squares = sum + length, *products = squares + length;
        for (int64_t i = 0; i < stride; i++) {
            const int32_t value = sign * x[i];
            sum[i] += value;
            squares[i] += value * x[i];
            products[i] += value * y[i];
        }
    }

  public:
    Windows(const Bytes& image, const Bytes& by, int64_t height, int64_t width, int64_t stride)
        : image(image), by(by), height(height), width(width), stride(stride), length(stride + WIDTH),
          columns(3 * length) {}

    // From the row before, or from the first.
    void slide(int64_t row) {
        if (row == 0) {
            std::fill(columns.begin(), columns.end(), 0);
            for (int64_t i = -REACH; i < REACH; i++) add(i, 1);
        } else
            add(row - REACH - 1, -1);
        add(row + REACH, 1);
        for (int n = 0; n < 3; n++) {
            int32_t *first = columns.data() + n * length + REACH, *last = first + width - 1;
            std::fill(first - REACH, first, *first);
            std::fill(last + 1, last + 1 + REACH, *last);
        }
    }

    IntLanes sum(int n, int64_t column) const {
        const int32_t* from = columns.data() + n * length + column;
        IntLanes all{};
        for (int i = 0; i < SIDE; i++) all += load_some<IntLanes>(from + i, WIDTH);
        return all;
    }
};

// 1 over the windows' standard deviations and number of pixels.
Lanes over_contrast(IntLanes sums, IntLanes squares) {
    return inverse_root(real(most(PIXELS * squares - sums * sums, whole(PIXELS * PIXELS))));
}

// Another image, with nothing around it, and what it shows of an image's pixels at an inverse depth.
struct Other {
    const int64_t height, width, stride, rows, columns; // of the image
    const float *linear, *b;
    std::vector<int32_t> corners, marks; // four bytes: a pixel, the one to its right, and the two below
    bool is_marked = false;
    Bytes seen, marked;
    Windows windows;

    Other(const uint8_t* gray, const uint8_t* marks_of, const int64_t* size, const float* linear, const float* b,
          const Bytes& image, int64_t rows, int64_t columns, int64_t stride)
        : height(size[0]), width(size[1]), stride(stride), rows(rows), columns(columns), linear(linear), b(b),
          corners((height + 2) * (width + 2)), marks(corners.size()), seen(rows * stride), marked(rows * stride),
          windows(seen, image, rows, columns, stride) {
        const int64_t line = width + 2;
        for (int64_t i = 0; i < height * width; i++) {
            const int64_t at = (i / width + 1) * line + i % width + 1;
            const uint32_t value = gray[i];
            corners[at] |= value;
            corners[at - 1] |= value << 8;
            corners[at - line] |= value << 16;
            corners[at - line - 1] |= value << 24;
            marks[at] = marks_of[i];
            is_marked |= marks_of[i] > 0;
        }
    }

    // Whether it shows anything.
    bool look(float q) {
        IntLanes all{};
        for (int64_t row = 0; row < rows; row++)
            for (int64_t column = 0; column < columns; column += WIDTH) {
                Lanes at[3];
                for (int i = 0; i < 3; i++) {
                    const float* m = linear + 3 * i;
                    at[i] = m[0] * (IOTA + (column + 0.5f)) + ((m[1] * (row + 0.5f) + m[2]) + q * b[i]);
                }
                const Mask ahead = at[2] > 0;
                const Lanes over = 1.0f / pick(ahead, at[2], splat(1));
                // What is no number becomes -1.
                const Lanes x = least(most(at[0] * over - 0.5f, splat(-1)), splat(width));
                const Lanes y = least(most(at[1] * over - 0.5f, splat(-1)), splat(height));
                const Lanes magic = splat(12582912.0f); // 1.5 * 2^23: adding it rounds to an integer
                const IntLanes to_right = truncated((x * float(STEPS) + magic) - magic);
                const IntLanes to_down = truncated((y * float(STEPS) + magic) - magic);
                const IntLanes u = to_right & (STEPS - 1), v = to_down & (STEPS - 1);
                const int32_t line = width + 2;
                const IntLanes four = gather(corners.data(), ((to_down >> 5) + 1) * line + (to_right >> 5) + 1);
                const auto between = [](IntLanes a, IntLanes b, IntLanes share) { return a * STEPS + share * (b - a); };
                const IntLanes upper = between(four & 255, four >> 8 & 255, u);
                const IntLanes lower = between(four >> 16 & 255, four >> 24 & 255, u);
                const IntLanes value = ((between(upper, lower, v) + STEPS * STEPS / 2) >> 10) & ahead;
                all |= value;
                write(seen, row, column, value);
                if (!is_marked) continue;
                const IntLanes nearest = truncated(y + 1.5f) * line + truncated(x + 1.5f);
                write(marked, row, column, gather(marks.data(), nearest) & ahead);
            }
        return any(all);
    }

    void write(Bytes& to, int64_t row, int64_t column, IntLanes values) const {
        const ByteLanes bytes = __builtin_convertvector(values, ByteLanes);
        __builtin_memcpy(to.data() + row * stride + column, &bytes, sizeof bytes);
    }

    static IntLanes read(const Bytes& from, int64_t place) {
        ByteLanes bytes;
        __builtin_memcpy(&bytes, from.data() + place, sizeof bytes);
        return __builtin_convertvector(bytes, IntLanes);
    }

    // Correlations with windows of which sums and `over_contrast` are given, in the row to which sums have slid.
    Lanes alike(IntLanes sums, Lanes over, int64_t row, int64_t column) const {
        const IntLanes theirs = windows.sum(0, column), product = PIXELS * windows.sum(2, column) - sums * theirs;
        const Lanes correlation = real(product) * over * over_contrast(theirs, windows.sum(1, column));
        return pick(read(seen, row * stride + column) > 0, correlation, splat(-1));
    }
};

void mmpi_most_alike(int64_t, int64_t, const uint8_t* gray, const uint8_t* others, const uint8_t* marked,
                     const int64_t* sizes, const float* linear, const float* b, const float* inverse,
                     const float* smallest, float largest, bool pairs, int64_t height, int64_t width, int64_t,
                     int64_t count, int64_t depths, float* alike, float* at) {
    const int64_t stride = (width + WIDTH - 1) / WIDTH * WIDTH, pixels = height * width;
    Bytes image(height * stride);
    for (int64_t row = 0; row < height; row++) std::copy_n(gray + row * width, width, image.data() + row * stride);
    std::vector<int32_t> sums(image.size());
    std::vector<float> contrasts(image.size());
    Windows windows(image, image, height, width, stride);
    for (int64_t row = 0; row < height; row++) {
        windows.slide(row);
        for (int64_t column = 0; column < width; column += WIDTH) {
            const IntLanes sum = windows.sum(0, column);
            store(sums.data() + row * stride + column, sum);
            store(contrasts.data() + row * stride + column, over_contrast(sum, windows.sum(1, column)));
        }
    }
    std::vector<Other> all;
    all.reserve(count); // windows refer to what they are of
    for (int64_t k = 0, first = 0; k < count; first += sizes[2 * k] * sizes[2 * k + 1], k++)
        all.emplace_back(others + first, marked + first, sizes + 2 * k, linear + 9 * k, b + 3 * k, image, height, width,
                         stride);
    std::fill(alike, alike + 3 * pixels, -1.0f);
    std::fill(at, at + 3 * pixels, 0.0f);
    std::vector<Other*> shown;
    for (int64_t d = 0; d < depths; d++) {
        const float q = inverse[d];
        shown.clear();
        for (Other& other : all)
            if (other.look(q)) shown.push_back(&other);
        for (int64_t row = 0; row < height; row++) {
            for (Other* other : shown) other->windows.slide(row);
            for (int64_t column = 0; column < width; column += WIDTH) {
                const int64_t here = row * stride + column, pixel = row * width + column, some = width - column;
                const IntLanes sum = load_some<IntLanes>(sums.data() + here, WIDTH);
                const Lanes over = load(contrasts.data() + here), bound = load_some<Lanes>(smallest + pixel, some);
                const Mask possible = (q >= bound) & (q <= largest ? -1 : 0);
                Lanes first = splat(-1), second = first, now[3] = {first, first, first};
                for (const Other* other : shown) {
                    const Lanes one = other->alike(sum, over, row, column);
                    second = most(second, least(first, one));
                    first = most(first, one);
                    if (pairs) continue;
                    const Mask is_marked = Other::read(other->marked, here) > 0, kinds[3] = {
                        possible & ~is_marked, ~possible & ~is_marked, is_marked};
                    for (int n = 0; n < 3; n++) now[n] = pick(kinds[n] & (one > now[n]), one, now[n]);
                }
                if (pairs) {
                    now[0] = pick(possible, (first + second) * 0.5f, now[0]);
                    now[1] = pick(possible, now[1], (first + second) * 0.5f);
                }
                for (int n = 0; n < 3; n++) {
                    float *best = alike + n * pixels + pixel, *its = at + n * pixels + pixel;
                    const Lanes before = load_some<Lanes>(best, some);
                    const Mask better = now[n] > before;
                    store_some(best, pick(better, now[n], before), some);
                    store_some(its, pick(better, splat(q), load_some<Lanes>(its, some)), some);
                }
            }
        }
    }
}

} // namespace

IN_PARTS(mmpi_most_alike)
