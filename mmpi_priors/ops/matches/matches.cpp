// Parallax between two images, sixteen pixels at a time: places of pixels, depths of matches, means of measurements.
#include "../cpp/some.h"
#include "parts.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace {

constexpr float FAR = -1e4f, LEAST_AHEAD = 1e-6f, AGREE = 2.5f; // as in __init__.py

// The three parts of a = linear (x, y, 1) at sixteen pixels of a row.
struct Linear {
    Lanes a[3];
    Linear(const float* linear, int64_t column, int64_t row) {
        for (int i = 0; i < 3; i++) {
            const float start = linear[3 * i + 1] * (row + 0.5f) + linear[3 * i + 2];
            a[i] = linear[3 * i] * (IOTA + (column + 0.5f)) + start;
        }
    }
};

// Rows [begin, end) of pixels at inverse depths: their places, and depths over those here.
void mmpi_place_pixels(int64_t begin, int64_t end, const float* inverse, const float* linear, const float* b,
                       int64_t, int64_t width, float* x, float* y, float* ahead) {
    for (int64_t row = begin; row < end; row++)
        for (int64_t column = 0; column < width; column += WIDTH) {
            const int64_t i = row * width + column, count = width - column;
            const Linear at(linear, column, row);
            const Lanes q = load_some<Lanes>(inverse + i, count), depth = at.a[2] + q * b[2];
            const Mask is_ahead = depth > LEAST_AHEAD;
            const Lanes divisor = pick(is_ahead, depth, splat(1));
            store_some(x + i, pick(is_ahead, (at.a[0] + q * b[0]) / divisor, splat(FAR)), count);
            store_some(y + i, pick(is_ahead, (at.a[1] + q * b[1]) / divisor, splat(FAR)), count);
            store_some(ahead + i, pick(is_ahead, depth, Lanes{}), count);
        }
}

// Rows [begin, end) of motions: values of two maps at the places moved to, interpolated, at most at the border.
void mmpi_follow_motion(int64_t begin, int64_t end, const float* x, const float* y, const float* motion,
                        int64_t height, int64_t width, float* moved_x, float* moved_y) {
    for (int64_t row = begin; row < end; row++)
        for (int64_t column = 0, i = row * width; column < width; column++, i++) {
            const float right = std::clamp(column + motion[2 * i], 0.0f, width - 1.0f);
            const float down = std::clamp(row + motion[2 * i + 1], 0.0f, height - 1.0f);
            // Of maps of one row or column, that one.
            const int32_t left = std::max(0, std::min(int32_t(right), int32_t(width - 2)));
            const int32_t top = std::max(0, std::min(int32_t(down), int32_t(height - 2)));
            const float u = right - left, v = down - top;
            const int64_t corner = top * width + left;
            const auto at = [&](const float* map) {
                const float* above = map + corner;
                const float* below = above + (height > 1 ? width : 0);
                const int64_t next = width > 1;
                const float upper = above[0] + u * (above[next] - above[0]);
                const float lower = below[0] + u * (below[next] - below[0]);
                return upper + v * (lower - upper);
            };
            moved_x[i] = at(x);
            moved_y[i] = at(y);
        }
}

// Rows [begin, end) of matches at (x, y): inverse depths and one over their squared errors.
void mmpi_solve_matches(int64_t begin, int64_t end, const float* x, const float* y, const float* alike,
                        const bool* usable, const float* linear, const float* b, float variance,
                        float farthest_squared, int64_t, int64_t width, float* inverse, float* certainty) {
    for (int64_t row = begin; row < end; row++)
        for (int64_t column = 0; column < width; column += WIDTH) {
            const int64_t i = row * width + column, count = width - column;
            const Linear at(linear, column, row);
            const Lanes u = load_some<Lanes>(x + i, count), v = load_some<Lanes>(y + i, count);
            const Lanes r1 = at.a[0] - u * at.a[2], s1 = b[0] - u * b[2];
            const Lanes r2 = at.a[1] - v * at.a[2], s2 = b[1] - v * b[2];
            const Lanes squared = most(s1 * s1 + s2 * s2, splat(1e-20f)), q = -(r1 * s1 + r2 * s2) / squared;
            const Lanes depth = at.a[2] + q * b[2], across = r1 * s2 - r2 * s1;
            const Lanes off_line = across * across / (squared * depth * depth);
            const Lanes noise = (variance + off_line) * (11 - 10 * least(splat(1), load_some<Lanes>(alike + i, count)));
            const Lanes sure = squared / (depth * depth * noise);
            const Mask finite = (magnitude(q) < INFINITY) & (magnitude(sure) < INFINITY);
            const Mask near = (depth > LEAST_AHEAD) & (off_line < farthest_squared);
            const Mask counts = widened(load_some<ByteLanes>(usable + i, count)) != 0;
            const Mask kept = counts & near & finite;
            store_some(inverse + i, pick(kept, q, Lanes{}), count);
            store_some(certainty + i, pick(kept, sure, Lanes{}), count);
        }
}

// Rows [begin, end) of depths: whether those of another image confirm or contradict them.
void mmpi_compare_depths(int64_t begin, int64_t end, const float* inverse, const float* error,
                         const float* their_inverse, const float* their_error, const float* linear, const float* b,
                         float same, int64_t, int64_t width, int64_t their_height, int64_t their_width,
                         bool* confirms, bool* contradicts) {
    for (int64_t row = begin; row < end; row++) {
        const float down = row + 0.5f;
        for (int64_t column = 0, i = row * width; column < width; column++, i++) {
            confirms[i] = contradicts[i] = false;
            const float q = inverse[i], right = column + 0.5f;
            if (!(q > 0)) continue;
            float at[3];
            for (int n = 0; n < 3; n++)
                at[n] = linear[3 * n] * right + (linear[3 * n + 1] * down + linear[3 * n + 2]) + q * b[n];
            if (!(at[2] > LEAST_AHEAD)) continue;
            const float x = std::nearbyint(at[0] / at[2] - 0.5f), y = std::nearbyint(at[1] / at[2] - 0.5f);
            if (!(x >= 0 && x < their_width && y >= 0 && y < their_height)) continue;
            const int64_t there = int64_t(y) * their_width + int64_t(x);
            if (!(their_inverse[there] > 0)) continue;
            const float expected = q / at[2], apart = their_inverse[there] - expected;
            const float squares = their_error[there] * their_error[there] + error[i] * error[i];
            const float tolerance = 3 * std::sqrt(squares) + same * expected;
            confirms[i] = std::abs(apart) < tolerance;
            contradicts[i] = apart < -tolerance;
        }
    }
}

// Rows [begin, end): mean of the largest consistent subset of each pixel's measurements, which lie `pixels` apart.
void mmpi_average_matches(int64_t begin, int64_t end, const float* inverse, const float* certainty, float most_relative,
                          int64_t measurements, int64_t rows, int64_t width, float* mean, float* error) {
    const int64_t pixels = rows * width;
    std::vector<Lanes> q(measurements), weight(measurements), variance(measurements);
    for (int64_t p = begin * width; p < end * width; p += WIDTH) {
        const int64_t count = end * width - p;
        Lanes all{}, measured{}, best{}, average{}, deviation{};
        for (int64_t n = 0; n < measurements; n++) {
            q[n] = load_some<Lanes>(inverse + n * pixels + p, count);
            weight[n] = load_some<Lanes>(certainty + n * pixels + p, count);
            variance[n] = AGREE * AGREE / most(weight[n], splat(1e-30f));
            all += weight[n];
            measured += pick(weight[n] > 0, splat(1), Lanes{});
        }
        const Lanes fewest = least(measured, splat(2));
        for (int64_t k = 0; k < measurements; k++) {
            // Relative to measurement k, so that sums of squares are exact.
            Lanes number{}, total{}, first{}, second{};
            for (int64_t n = 0; n < measurements; n++) {
                const Lanes apart = q[n] - q[k];
                const Mask agrees = (weight[n] > 0) & (apart * apart < variance[n] + variance[k]);
                const Lanes w = pick(agrees, weight[n], Lanes{});
                number += pick(agrees, splat(1), Lanes{});
                total += w;
                first += w * apart;
                second += w * apart * apart;
            }
            total = most(total, splat(1e-30f));
            const Lanes shift = first / total, middle = q[k] + shift, value = number + total / most(all, splat(1e-30f));
            const Lanes scatter = most(second - first * shift, Lanes{}) / most(number - 1, splat(1));
            const Mask better = (weight[k] > 0) & (number >= fewest) & (middle > 0) & (value > best);
            best = pick(better, value, best);
            average = pick(better, middle, average);
            deviation = pick(better, root(most(scatter, splat(1)) / total), deviation);
        }
        const Mask kept = (best > 0) & (deviation < most_relative * average);
        store_some(mean + p, pick(kept, average, Lanes{}), count);
        store_some(error + p, pick(kept, deviation, Lanes{}), count);
    }
}

} // namespace

IN_PARTS(mmpi_place_pixels)
IN_PARTS(mmpi_follow_motion)
IN_PARTS(mmpi_solve_matches)
IN_PARTS(mmpi_compare_depths)
IN_PARTS(mmpi_average_matches)
