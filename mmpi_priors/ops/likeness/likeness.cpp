// How alike an image and others are at some inverse depths, by windows whose sums slide from row to row.
#include "../cpp/some.h"
#include "parts.h"

#include <algorithm>
#include <cstdint>
#include <vector>

namespace {

// 1 / sqrt(x) to 1e-6, for x >= 1e-20.
Lanes inverse_root(Lanes x) {
#ifdef __AVX512F__
    const Lanes rough = Lanes::of([](FloatPiece a) { return FloatPiece(_mm512_rsqrt14_ps(__m512(a))); }, x);
    return rough * (1.5f - 0.5f * x * rough * rough);
#endif
    return 1.0f / root(x);
}

constexpr int REACH = 3, SIDE = 2 * REACH + 1, PIXELS = SIDE * SIDE, BITS = 5, STEPS = 1 << BITS; // as in __init__.py

// An image, or what another one shows of its pixels, in rows of whole lanes; and sums over windows about the pixels of
// a row: of the gray levels, of their squares, and of their products with the image's.
struct Window {
    const int64_t height, width, stride = (width + WIDTH - 1) / WIDTH * WIDTH, length = stride + WIDTH;
    std::vector<int32_t> gray = std::vector<int32_t>(height * stride), marks = gray;
    std::vector<int32_t> columns = std::vector<int32_t>(3 * length);

    void add(const Window& image, int64_t row, int32_t sign) {
        const int64_t from = std::clamp<int64_t>(row, 0, height - 1) * stride;
        const int32_t *x = gray.data() + from, *y = image.gray.data() + from;
        int32_t *sum = columns.data() + REACH, *squares = sum + length, *products = squares + length;
        for (int64_t i = 0; i < width; i++) {
            sum[i] += sign * x[i];
            squares[i] += sign * x[i] * x[i];
            products[i] += sign * x[i] * y[i];
        }
    }

    // To a row from the one before, or to the first.
    void slide(const Window& image, int64_t row) {
        if (row == 0) std::fill(columns.begin(), columns.end(), 0);
        for (int64_t i = -REACH; row == 0 && i < REACH; i++) add(image, i, 1);
        if (row > 0) add(image, row - REACH - 1, -1);
        add(image, row + REACH, 1);
        for (int n = 0; n < 3; n++) {
            int32_t *first = columns.data() + n * length + REACH, *last = first + width - 1;
            std::fill(first - REACH, first, *first);
            std::fill(last + 1, last + 1 + REACH, *last);
        }
    }

    IntLanes sum(int n, int64_t column) const {
        IntLanes all{};
        for (int i = 0; i < SIDE; i++) all += load_some<IntLanes>(columns.data() + n * length + column + i, WIDTH);
        return all;
    }

    // 1 over the standard deviations and the number of pixels.
    Lanes over_contrast(int64_t column) const {
        const IntLanes sums = sum(0, column), variance = PIXELS * sum(1, column) - sums * sums;
        return inverse_root(real(most(variance, whole(PIXELS * PIXELS))));
    }

    // Looks at an inverse depth. Levels: first pixel, height and width of another image, and of its marks.
    void look(const int32_t* corners, const int64_t* levels, const float* linear, const float* b, float q,
              bool at_marks) {
        const int32_t line = levels[2];
        for (int64_t place = 0; place < height * stride; place += WIDTH) {
            const float row = place / stride + 0.5f, column = place % stride + 0.5f;
            Lanes at[3];
            for (int i = 0; i < 3; i++)
                at[i] = linear[3 * i] * (IOTA + column) + ((linear[3 * i + 1] * row + linear[3 * i + 2]) + q * b[i]);
            const Mask ahead = at[2] > 0;
            const Lanes over = 1.0f / pick(ahead, at[2], splat(1));
            const Lanes magic = splat(12582912.0f); // 1.5 * 2^23: adding it rounds to an integer
            // What is no number becomes 0, which is on the border.
            const Lanes x = least(most(at[0] * over + 0.5f, Lanes{}), splat(line - 1));
            const Lanes y = least(most(at[1] * over + 0.5f, Lanes{}), splat(levels[1] - 1));
            const IntLanes right = truncated((x * float(STEPS) + magic) - magic), u = right & (STEPS - 1);
            const IntLanes down = truncated((y * float(STEPS) + magic) - magic), v = down & (STEPS - 1);
            const IntLanes four = gather(corners + levels[0], (down >> BITS) * line + (right >> BITS));
            const auto between = [](IntLanes a, IntLanes b, IntLanes share) { return a * STEPS + share * (b - a); };
            const IntLanes upper = between(four & 255, four >> 8 & 255, u);
            const IntLanes lower = between(four >> 16 & 255, four >> 24 & 255, u);
            store(gray.data() + place, ((between(upper, lower, v) + STEPS * STEPS / 2) >> 2 * BITS) & ahead);
            if (!at_marks) continue;
            const IntLanes nearest = truncated(y + 0.5f) * line + truncated(x + 0.5f);
            store(marks.data() + place, gather(corners + levels[3], nearest) & 255 & ahead);
        }
    }
};

void mmpi_most_alike(int64_t, int64_t, const uint8_t* gray, const int32_t* corners, const int64_t* levels,
                     const float* linear, const float* b, const float* inverse, const float* smallest, float largest,
                     bool pairs, int64_t height, int64_t width, int64_t, int64_t count, int64_t, int64_t depths,
                     float* alike, float* at) {
    Window image{height, width};
    for (int64_t i = 0; i < height * width; i++) image.gray[i / width * image.stride + i % width] = gray[i];
    std::vector<Window> others(count, image);
    for (int64_t i = 0; i < 3 * height * width; i++) alike[i] = -1, at[i] = 0;
    for (const float* q = inverse; q < inverse + depths; q++) {
        for (int64_t k = 0; k < count; k++)
            others[k].look(corners, levels + 6 * k, linear + 9 * k, b + 3 * k, *q, !pairs);
        for (int64_t row = 0; row < height; row++) {
            image.slide(image, row);
            for (Window& other : others) other.slide(image, row);
            for (int64_t column = 0; column < width; column += WIDTH) {
                const int64_t here = row * image.stride + column, pixel = row * width + column, some = width - column;
                const IntLanes sum = image.sum(0, column);
                const Lanes over = image.over_contrast(column);
                const Mask possible = (*q >= load_some<Lanes>(smallest + pixel, some)) & whole(-(*q <= largest));
                Lanes first = splat(-1), second = first, best[3] = {first, first, first};
                const auto take = [&](Lanes one, Mask marked) {
                    const Mask kinds[3] = {possible & ~marked, ~possible & ~marked, marked};
                    for (int n = 0; n < 3; n++) best[n] = pick(kinds[n], most(one, best[n]), best[n]);
                };
                for (const Window& other : others) {
                    const IntLanes products = PIXELS * other.sum(2, column) - sum * other.sum(0, column);
                    const Mask is_visible = load_some<IntLanes>(other.gray.data() + here, WIDTH) > 0;
                    const Lanes one = pick(is_visible, real(products) * over * other.over_contrast(column), splat(-1));
                    second = most(second, least(first, one));
                    first = most(first, one);
                    if (!pairs) take(one, load_some<IntLanes>(other.marks.data() + here, WIDTH) > 0);
                }
                if (pairs) take((first + second) * 0.5f, Mask{});
                for (int n = 0; n < 3; n++) {
                    float *alike_now = alike + n * height * width + pixel, *at_now = at + n * height * width + pixel;
                    const Mask better = best[n] > load_some<Lanes>(alike_now, some);
                    store_some(alike_now, pick(better, best[n], load_some<Lanes>(alike_now, some)), some);
                    store_some(at_now, pick(better, splat(*q), load_some<Lanes>(at_now, some)), some);
                }
            }
        }
    }
}

} // namespace

IN_PARTS(mmpi_most_alike)
