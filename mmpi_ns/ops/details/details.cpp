// Residuals of a training image at the surfaces of rays, and their weights.
#include "parts.h"

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace {

using std::exp, std::max, std::min;
#include "details.h"

float norm(const float* v) { return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

// A camera's 24 numbers.
struct Camera {
    float pose[12], fx, fy, cx, cy, k1, k2, k3, k4, p1, p2, fisheye, reach;

    // Pixel of a direction in world axes; false outside the image.
    bool project(const float* direction, int64_t height, int64_t width, float& column, float& row) const {
        float local[3];
        for (int i = 0; i < 3; i++)
            local[i] = direction[0] * pose[i] + direction[1] * pose[4 + i] + direction[2] * pose[8 + i];
        const float x = local[0], y = -local[1], ahead = -local[2], radius = std::sqrt(x * x + y * y);
        if (fisheye <= 0 && ahead <= TINY) return false;
        const float scale = fisheye > 0 ? std::atan2(radius, ahead) / std::max(radius, TINY) : 1 / ahead;
        if (!(radius * scale <= reach)) return false;
        const float u = x * scale, v = y * scale, r = u * u + v * v;
        const float radial = 1 + r * (k1 + r * (k2 + r * (k3 + r * k4)));
        column = fx * (radial * u + 2 * p1 * u * v + p2 * (r + 2 * u * u)) + cx;
        row = fy * (radial * v + 2 * p2 * u * v + p1 * (r + 2 * v * v)) + cy;
        return column > 0 && column < width && row > 0 && row < height;
    }
};

// Four interpolated values of an image at a pixel coordinate; pixel centres are at halves, and borders are repeated.
void look_up(const float* image, int64_t height, int64_t width, float column, float row, float* values) {
    const float x = std::clamp(column - 0.5f, 0.0f, float(width - 1)), y = std::clamp(row - 0.5f, 0.0f, float(height - 1));
    const int64_t left = int64_t(x), top = int64_t(y);
    const int64_t right = std::min(left + 1, width - 1), bottom = std::min(top + 1, height - 1);
    const float u = x - left, v = y - top;
    const float* above = image + 4 * top * width;
    const float* below = image + 4 * bottom * width;
    for (int i = 0; i < 4; i++) {
        const float upper = (1 - u) * above[4 * left + i] + u * above[4 * right + i];
        const float lower = (1 - u) * below[4 * left + i] + u * below[4 * right + i];
        values[i] = (1 - v) * upper + v * lower;
    }
}

// Rays [begin, end): the image's values at their surfaces, and weights.
void mmpi_seen_details(int64_t begin, int64_t end, const float* origins, const float* directions, const float* inverse,
                       const float* radiance, const float* image, const float* numbers, int64_t, int64_t height, int64_t width,
                       float* difference, float* weight) {
    const Camera& camera = *reinterpret_cast<const Camera*>(numbers);
    for (int64_t i = begin; i < end; i++) {
        const float* direction = directions + 3 * i;
        float towards[3], relative[3], turn[3], values[4] = {}, column, row;
        for (int k = 0; k < 3; k++) {
            towards[k] = origins[3 * i + k] - camera.pose[4 * k + 3];
            relative[k] = inverse[i] * towards[k] + direction[k];
        }
        const float length = std::max(norm(relative), TINY);
        weight[i] = 0;
        if (camera.project(relative, height, width, column, row)) {
            look_up(image, height, width, column, row, values);
            const float there = values[3], here = inverse[i] / length;
            for (int k = 0; k < 3; k++) turn[k] = relative[k] / length - direction[k];
            const float angle = norm(turn);
            if (there >= 0) weight[i] = agreement(there, here, camera.fx * norm(towards), angle);
            for (int k = 0; k < 3; k++) values[k] = (values[k] - HERE * (radiance[3 * i + k] - MIDDLE)) * faded(angle);
        }
        for (int k = 0; k < 3; k++) difference[3 * i + k] = values[k];
    }
}

} // namespace

IN_PARTS(mmpi_seen_details)
