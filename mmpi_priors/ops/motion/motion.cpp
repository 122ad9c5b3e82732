// Motion of overlapping patches of an image to another one that looks nearly alike, by least squares.
#include "parts.h"
#include "table.h"

#include <algorithm>
#include <vector>

namespace {

constexpr int SIDE = OCTET, BORDER = SIDE + 1; // as in __init__.py
constexpr float PIXELS = SIDE * SIDE, FLAT = 16, FAR_APART = 0.25f * 0.25f, FARTHEST = 8 * 8;

float sum(Octet x) { return ((x[0] + x[1]) + (x[2] + x[3])) + ((x[4] + x[5]) + (x[6] + x[7])); }

// An image in floats, with pixels of the border around it.
struct Padded {
    int64_t height, width, stride;
    std::vector<float> pixels;

    Padded(const uint8_t* gray, int64_t height, int64_t width)
        : height(height), width(width), stride(width + 2 * BORDER), pixels((height + 2 * BORDER) * stride) {
        for (int64_t row = 0; row < height + 2 * BORDER; row++) {
            const uint8_t* from = gray + std::clamp<int64_t>(row - BORDER, 0, height - 1) * width;
            float* to = pixels.data() + row * stride;
            std::fill(to, to + BORDER, float(from[0]));
            for (int64_t column = 0; column < width; column++) to[BORDER + column] = from[column];
            std::fill(to + BORDER + width, to + stride, float(from[width - 1]));
        }
    }

    const float* at(int64_t row, int64_t column) const {
        return pixels.data() + (row + BORDER) * stride + column + BORDER;
    }
};

struct Motion {
    float right, down;
};

// A patch of an image, its gradients less their means, and the inverse of their products' sums.
struct Patch {
    const int64_t row, column;
    Octet gray[SIDE], right[SIDE], down[SIDE];
    float xx = FLAT, xy = 0, yy = FLAT;

    Patch(const Padded& image, int64_t row, int64_t column) : row(row), column(column) {
        Octet across[SIDE + 2], smooth[SIDE + 2], all_right{}, all_down{}, a{}, b{}, c{};
        for (int n = 0; n < SIDE + 2; n++) {
            const float* from = image.at(row + n - 1, column);
            const Octet middle = load_octet(from), before = load_octet(from - 1), after = load_octet(from + 1);
            across[n] = after - before;
            smooth[n] = before + 2.0f * middle + after;
            if (n > 0 && n <= SIDE) gray[n - 1] = middle;
        }
        for (int n = 0; n < SIDE; n++) {
            right[n] = (across[n] + 2.0f * across[n + 1] + across[n + 2]) * 0.125f;
            down[n] = (smooth[n + 2] - smooth[n]) * 0.125f;
            all_right += right[n];
            all_down += down[n];
        }
        const float mean_right = sum(all_right) / PIXELS, mean_down = sum(all_down) / PIXELS;
        for (int n = 0; n < SIDE; n++) {
            right[n] -= mean_right;
            down[n] -= mean_down;
            a += right[n] * right[n];
            b += right[n] * down[n];
            c += down[n] * down[n];
        }
        const float p = sum(a) + FLAT, q = sum(b), r = sum(c) + FLAT, determinant = p * r - q * q;
        xx = r / determinant;
        xy = -q / determinant;
        yy = p / determinant;
    }

    // each(n, difference of row n) where another image is at a motion.
    template <class Each> void differences(const Padded& other, Motion at, const Each& each) const {
        const float x = std::clamp(column + at.right, 1.0f - SIDE, other.width - 1.0f);
        const float y = std::clamp(row + at.down, 1.0f - SIDE, other.height - 1.0f);
        const float left = std::floor(x), top = std::floor(y), u = x - left, v = y - top;
        const float* from = other.at(int64_t(top), int64_t(left));
        const auto between = [&](const float* at) { return load_octet(at) + u * (load_octet(at + 1) - load_octet(at)); };
        Octet above = between(from);
        for (int n = 0; n < SIDE; n++) {
            const Octet below = between(from += other.stride);
            each(n, above + v * (below - above) - gray[n]);
            above = below;
        }
    }

    // Sum of squared differences less their mean; and the step that makes it least, if it is asked for.
    float error(const Padded& other, Motion at, Motion* step) const {
        Octet all{}, squares{}, along{}, across{};
        differences(other, at, [&](int n, Octet apart) {
            all += apart;
            squares += apart * apart;
            along += apart * right[n];
            across += apart * down[n];
        });
        const float mean = sum(all), x = sum(along), y = sum(across);
        if (step) *step = {-(xx * x + xy * y), -(xy * x + yy * y)};
        return sum(squares) - mean * mean / PIXELS;
    }

    // The best of some steps from a motion.
    Motion descended(const Padded& other, Motion start, int64_t rounds, float& best_error) const {
        Motion best = start, at = start, step{};
        best_error = INFINITY;
        for (int64_t n = 0; n < rounds; n++) {
            const float now = error(other, at, &step);
            if (!(now < best_error)) break;
            best = at;
            best_error = now;
            at = {at.right + step.right, at.down + step.down};
            const float x = at.right - start.right, y = at.down - start.down;
            if (!(x * x + y * y <= FARTHEST)) break;
        }
        return best;
    }
};

// A motion at a place of a map of them, interpolated.
Motion between(const float* motion, int64_t height, int64_t width, float x, float y) {
    x = std::clamp(x, 0.0f, width - 1.0f);
    y = std::clamp(y, 0.0f, height - 1.0f);
    const int64_t left = std::max<int64_t>(0, std::min<int64_t>(x, width - 2)), next = 2 * (width > 1);
    const int64_t top = std::max<int64_t>(0, std::min<int64_t>(y, height - 2)), below = height > 1 ? 2 * width : 0;
    const float u = x - left, v = y - top, *from = motion + 2 * (top * width + left);
    const auto part = [&](const float* at) {
        const float upper = at[0] + u * (at[next] - at[0]), lower = at[below] + u * (at[below + next] - at[below]);
        return upper + v * (lower - upper);
    };
    return {part(from), part(from + 1)};
}

void mmpi_refine_motion(int64_t, int64_t, const uint8_t* gray, const uint8_t* other_gray, const float* coarse,
                        int64_t stride, int64_t rounds, int64_t height, int64_t width, int64_t coarse_height,
                        int64_t coarse_width, float* motion) {
    const Padded image(gray, height, width), other(other_gray, height, width);
    const int64_t down = 1 + (height - SIDE) / stride, across = 1 + (width - SIDE) / stride;
    std::vector<Motion> first(down * across), last(down * across);
    std::vector<float> errors(down * across);
    const float scale_x = float(coarse_width) / width, scale_y = float(coarse_height) / height;
    for (int64_t i = 0; i < down; i++)
        for (int64_t j = 0; j < across; j++) {
            const float x = (j * stride + SIDE / 2 + 0.5f) * scale_x - 0.5f;
            const float y = (i * stride + SIDE / 2 + 0.5f) * scale_y - 0.5f;
            Motion start = between(coarse, coarse_height, coarse_width, x, y);
            start = {start.right / scale_x, start.down / scale_y};
            const Patch patch(image, i * stride, j * stride);
            first[i * across + j] = patch.descended(other, start, rounds, errors[i * across + j]);
        }
    std::vector<float> totals(height * width), rights(height * width), downs(height * width);
    for (int64_t i = 0; i < down; i++)
        for (int64_t j = 0; j < across; j++) {
            const Patch patch(image, i * stride, j * stride);
            const Motion mine = first[i * across + j];
            Motion best = mine;
            float least = errors[i * across + j];
            const int64_t beside[4][2] = {{i, j - 1}, {i, j + 1}, {i - 1, j}, {i + 1, j}};
            for (const auto& [r, c] : beside) {
                if (r < 0 || r >= down || c < 0 || c >= across) continue;
                const Motion theirs = first[r * across + c];
                const float x = theirs.right - mine.right, y = theirs.down - mine.down;
                if (!(x * x + y * y > FAR_APART)) continue;
                const float now = patch.error(other, theirs, nullptr);
                if (now < least) least = now, best = theirs;
            }
            if (best.right != mine.right || best.down != mine.down)
                best = patch.descended(other, best, rounds, least);
            patch.differences(other, best, [&](int n, Octet apart) {
                const int64_t at = (i * stride + n) * width + j * stride;
                for (int k = 0; k < SIDE; k++) {
                    const float weight = 1.0f / std::max(1.0f, std::fabs(apart[k]));
                    totals[at + k] += weight;
                    rights[at + k] += weight * best.right;
                    downs[at + k] += weight * best.down;
                }
            });
        }
    // Beyond the last patch as in it.
    const int64_t last_row = (down - 1) * stride + SIDE - 1, last_column = (across - 1) * stride + SIDE - 1;
    for (int64_t row = 0; row < height; row++)
        for (int64_t column = 0; column < width; column++) {
            const int64_t at = std::min(row, last_row) * width + std::min(column, last_column);
            motion[2 * (row * width + column)] = rights[at] / totals[at];
            motion[2 * (row * width + column) + 1] = downs[at] / totals[at];
        }
}

} // namespace

IN_PARTS(mmpi_refine_motion)
