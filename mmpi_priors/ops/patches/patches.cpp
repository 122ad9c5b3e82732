// Planes through the pixels of an image that make other images look like it, sixteen pixels at a time.
#include "../cpp/some.h"
#include "parts.h"

#include <algorithm>

namespace {

// 1 / x to 1e-7, for x >= 1e-12.
Lanes reciprocal(Lanes x) {
#ifdef __AVX512F__
    const Lanes rough = Lanes::of([](FloatPiece a) { return FloatPiece(_mm512_rcp14_ps(__m512(a))); }, x);
    return rough * (2.0f - x * rough);
#endif
    return 1.0f / x;
}

constexpr int REACH = 2, SIDE = 2 * REACH + 1, PIXELS = SIDE * SIDE, LEVELS = 3; // as in __init__.py
constexpr float LEAST_AHEAD = 1e-6f, LEAST_SHARE = 0.2f, LEAST_SQUARES = PIXELS, ALONE = 0.1f, GRAZING = 0.05f;

struct Plane {
    Lanes q, right, down;
};

// Between four bytes: a pixel, the one to its right, and the two below.
Lanes between(IntLanes corners, Lanes u, Lanes v) {
    const Lanes a = real(corners & 255), b = real(corners >> 8 & 255);
    const Lanes c = real(corners >> 16 & 255), d = real(corners >> 24 & 255);
    const Lanes upper = a + u * (b - a), lower = c + u * (d - c);
    return upper + v * (lower - upper);
}

// Another image, and where the image's pixels at inverse depths are in it.
struct Other {
    const int32_t* corners;
    const int64_t* sizes; // first pixel, height, width of each level
    const float* linear;
    const float* b;

    // Correlations with sixteen patches whose values less their means are given; -1 where it does not show them.
    Lanes alike(const Lanes* values, Lanes squares, Lanes x, float y, const Plane& plane, float stride,
                Mask& visible) const {
        Lanes middle[3], right[3], down[3];
        for (int i = 0; i < 3; i++) {
            const float* m = linear + 3 * i;
            middle[i] = m[0] * x + (m[1] * y + m[2]) + plane.q * b[i];
            right[i] = m[0] + plane.right * b[i];
            down[i] = m[1] + plane.down * b[i];
        }
        const Mask ahead = middle[2] > LEAST_AHEAD;
        const Lanes over = 1.0f / pick(ahead, middle[2], splat(1)), column = middle[0] * over, row = middle[1] * over;
        const float height = sizes[4], width = sizes[5];
        visible = ahead & (column >= 0.5f) & (column <= width - 0.5f) & (row >= 0.5f) & (row <= height - 0.5f);
        if (!any(visible)) return splat(-1);
        // Pixels there for a pixel here decide the size at which the image is looked at.
        const Lanes xr = right[0] - column * right[2], yr = right[1] - row * right[2];
        const Lanes xd = down[0] - column * down[2], yd = down[1] - row * down[2];
        const Lanes area = magnitude(xr * yd - xd * yr) * over * over;
        const Mask large = area < 0.5f, small = area > 2.0f;
        const auto level = [&](int n) {
            return pick(large, whole(sizes[n]), pick(small, whole(sizes[6 + n]), whole(sizes[3 + n])));
        };
        const IntLanes first = level(0), widths = level(2);
        const Lanes last_row = real(level(1)) - 1.0f, last_column = real(widths) - 1.0f;
        const Lanes to_columns = (last_column + 1.0f) / width, to_rows = (last_row + 1.0f) / height;
        // Places less a half, times the depth: linear in the pixel.
        const auto numerator = [&](const Lanes* of, int i, Lanes scale) { return of[i] * scale - 0.5f * of[2]; };
        const Lanes to_x = numerator(right, 0, to_columns), to_y = numerator(right, 1, to_rows);
        const Lanes down_x = numerator(down, 0, to_columns), down_y = numerator(down, 1, to_rows);
        const Lanes start_x = numerator(middle, 0, to_columns), start_y = numerator(middle, 1, to_rows);
        Lanes seen[PIXELS], sum{}, nearest = middle[2];
        for (int i = 0; i < SIDE; i++) {
            const float below = (i - REACH) * stride;
            const Lanes depths = middle[2] + below * down[2];
            const Lanes row_x = start_x + below * down_x, row_y = start_y + below * down_y;
#pragma GCC unroll 5
            for (int j = 0; j < SIDE; j++) {
                const float beside = (j - REACH) * stride;
                const Lanes depth = depths + beside * right[2];
                nearest = least(nearest, depth);
                const Lanes over = reciprocal(most(depth, splat(1e-12f)));
                // What is no number, where nothing is visible, becomes 0.
                const Lanes u = least(most((row_x + beside * to_x) * over, Lanes{}), last_column);
                const Lanes v = least(most((row_y + beside * to_y) * over, Lanes{}), last_row);
                const IntLanes left = truncated(u), top = truncated(v);
                const Lanes value = between(gather(corners, first + top * widths + left), u - real(left), v - real(top));
                sum += seen[SIDE * i + j] = value;
            }
        }
        Lanes their_squares{}, product{};
        const Lanes mean = sum * (1.0f / PIXELS);
        for (int n = 0; n < PIXELS; n++) {
            const Lanes value = seen[n] - mean;
            their_squares += value * value;
            product += value * values[n];
        }
        const Lanes correlation = product / root(most(their_squares * squares, splat(1e-20f)));
        const Lanes textured = pick(their_squares >= LEAST_SQUARES, correlation, splat(-1));
        return pick(visible, pick(nearest >= LEAST_SHARE * middle[2], textured, splat(-1)), splat(-1));
    }
};

// An image and what it is compared with.
struct Image {
    int64_t height, width;
    const uint8_t* gray;
    const int32_t* corners;
    const int64_t* sizes;
    const float *linear, *b;
    int64_t count, stride;
};

// Sixteen pixels of a row, some of them perhaps past its end, and the best planes so far.
struct Pixels {
    const Image& of;
    const int64_t row, column, count;
    Lanes values[PIXELS], squares{}, x;
    float y;
    Plane best;
    Lanes alike;

    Pixels(const Image& of, int64_t row, int64_t column, const float* planes, const float* correlations)
        : of(of), row(row), column(column), count(std::min<int64_t>(of.width - column, WIDTH)),
          x(IOTA + (column + 0.5f)), y(row + 0.5f) {
        Lanes sum{};
        for (int n = 0; n < PIXELS; n++) {
            const int64_t down = std::clamp<int64_t>(row + (n / SIDE - REACH) * of.stride, 0, of.height - 1);
            float each[WIDTH];
            for (int64_t i = 0; i < WIDTH; i++) {
                const int64_t right = column + i + (n % SIDE - REACH) * of.stride;
                each[i] = of.gray[down * of.width + std::clamp<int64_t>(right, 0, of.width - 1)];
            }
            values[n] = load(each);
            sum += values[n];
        }
        for (Lanes& value : values) {
            value -= sum * (1.0f / PIXELS);
            squares += value * value;
        }
        best = read(planes, row, column);
        alike = load_some<Lanes>(correlations + row * of.width + column, count);
    }

    // Planes of pixels from a place on; where the image has none, of the nearest in the row.
    Plane read(const float* planes, int64_t row, int64_t column) const {
        float each[3][WIDTH];
        for (int64_t i = 0; i < WIDTH; i++) {
            const int64_t at = row * of.width + std::clamp<int64_t>(column + i, 0, of.width - 1);
            for (int n = 0; n < 3; n++) each[n][i] = planes[3 * at + n];
        }
        return {load(each[0]), load(each[1]), load(each[2])};
    }

    void compare(const Plane& plane, Mask counts) {
        counts &= (plane.q > 0) & (squares >= LEAST_SQUARES);
        if (!any(counts)) return;
        Lanes first = splat(-1), second = splat(-1);
        Mask is_visible{}, is_hidden{};
        for (int64_t k = 0; k < of.count; k++) {
            const Other other{of.corners, of.sizes + 3 * LEVELS * k, of.linear + 9 * k, of.b + 3 * k};
            Mask visible;
            const Lanes one = other.alike(values, squares, x, y, plane, of.stride, visible);
            is_visible |= visible;
            is_hidden |= ~visible;
            second = most(second, least(first, one));
            first = most(first, one);
        }
        second = of.count == 1 ? first : pick(is_hidden, most(second, first - ALONE), second);
        const Lanes mean = (first + second) * 0.5f;
        const Mask better = counts & is_visible & (mean > alike);
        alike = pick(better, mean, alike);
        best = {pick(better, plane.q, best.q), pick(better, plane.right, best.right),
                pick(better, plane.down, best.down)};
    }

    void write(float* planes, float* correlations) const {
        float each[4][WIDTH];
        store(each[0], best.q), store(each[1], best.right), store(each[2], best.down), store(each[3], alike);
        for (int64_t i = 0; i < count; i++) {
            const int64_t at = row * of.width + column + i;
            for (int n = 0; n < 3; n++) planes[3 * at + n] = each[n][i];
            correlations[at] = each[3][i];
        }
    }
};

// A plane of the same inverse depth, with something added to its unit normal.
Plane turned(const Plane& plane, const Plane& turn, Lanes x, float y, const float* pinhole) {
    const float fx = pinhole[0], fy = pinhole[1];
    const Lanes u = x - pinhole[2], v = splat(y - pinhole[3]);
    Lanes a = fx * plane.right, b = fy * plane.down, c = plane.q - plane.right * u - plane.down * v;
    const Lanes length = most(root(a * a + b * b + c * c), splat(1e-20f));
    a = a / length + turn.q;
    b = b / length + turn.right;
    c = c / length + turn.down;
    const Lanes towards = a * u / fx + b * v / fy + c;
    const Lanes scale = plane.q / pick(towards < 0, least(towards, splat(-GRAZING)), most(towards, splat(GRAZING)));
    return {plane.q, scale * a / fx, scale * b / fy};
}

// Rows [begin, end) of an image: the better ones of two planes at each pixel.
void mmpi_compare_planes(int64_t begin, int64_t end, const uint8_t* gray, const float* planes, const float* alike,
                         const float* others, const int32_t* corners, const int64_t* sizes, const float* linear,
                         const float* b, int64_t stride, int64_t height, int64_t width, int64_t, int64_t count,
                         int64_t, float* best, float* best_alike) {
    const Image image{height, width, gray, corners, sizes, linear, b, count, stride};
    for (int64_t row = begin; row < end; row++)
        for (int64_t column = 0; column < width; column += WIDTH) {
            Pixels here(image, row, column, planes, alike);
            here.compare(here.read(others, row, column), whole(-1));
            here.write(best, best_alike);
        }
}

// Rows [begin, end) of an image: the best of each pixel's plane, those around it, and two that differ a little.
void mmpi_spread_planes(int64_t begin, int64_t end, const uint8_t* gray, const float* planes, const float* alike,
                        const float* changes, const float* pinhole, const int32_t* corners, const int64_t* sizes,
                        const float* linear, const float* b, int64_t stride, int64_t offset, int64_t height,
                        int64_t width, int64_t, int64_t count, int64_t, float* best, float* best_alike) {
    const Image image{height, width, gray, corners, sizes, linear, b, count, stride};
    const int64_t shifts[4][2] = {{-offset, 0}, {offset, 0}, {0, -offset}, {0, offset}};
    for (int64_t row = begin; row < end; row++)
        for (int64_t column = 0; column < width; column += WIDTH) {
            Pixels here(image, row, column, planes, alike);
            for (const auto& [right, down] : shifts) {
                if (row + down < 0 || row + down >= height) continue;
                Plane plane = here.read(planes, row + down, column + right);
                plane.q -= plane.right * float(right) + plane.down * float(down);
                const Lanes at = here.x + float(right);
                here.compare(plane, (at > 0) & (at < float(width)));
            }
            float each[4][WIDTH] = {};
            for (int64_t i = 0; i < here.count; i++)
                for (int n = 0; n < 4; n++) each[n][i] = changes[4 * (row * width + column + i) + n];
            const Lanes factor = exp_lanes(load(each[0]) * 0.693147181f);
            here.compare({here.best.q * factor, here.best.right * factor, here.best.down * factor}, whole(-1));
            const Plane nearer{here.best.q / factor, here.best.right / factor, here.best.down / factor};
            const Plane turn{load(each[1]), load(each[2]), load(each[3])};
            here.compare(turned(nearer, turn, here.x, here.y, pinhole), whole(-1));
            here.write(best, best_alike);
        }
}

} // namespace

IN_PARTS(mmpi_compare_planes)
IN_PARTS(mmpi_spread_planes)
