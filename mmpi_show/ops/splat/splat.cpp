// Gaussians seen by a camera: projected, sorted by depth, and laid over each other front to back.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace {

constexpr float BLUR = 0.3f, FAINTEST = 1.0f / 255, STRONGEST = 0.99f, OPAQUE = 1e-4f, NEAREST = 0.01f, ASIDE = 1.3f;

struct View {
    float to_world[3][4]; // from camera axes: x right, y up, looking along -z
    float fx, fy, cx, cy;
    int32_t width, height;
};

// A Gaussian in the image: its middle, the inverse of its covariance, and the pixels that it reaches.
struct Seen {
    float z, u, v, a, b, c, alpha;
    int32_t left, right, top, bottom, index;
};

// False where it is not seen.
bool project(const View& view, const float* mean, const float* covariance, float alpha, Seen& seen) {
    float at[3] = {0, 0, 0}, axes[3][3]; // rows: right, down, ahead
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            axes[i][j] = (i ? -1 : 1) * view.to_world[j][i];
            at[i] += axes[i][j] * (mean[j] - view.to_world[j][3]);
        }
    const float z = at[2];
    if (!(z > NEAREST) || alpha < FAINTEST) return false;
    const float aside = ASIDE * float(view.width) / (2 * view.fx), above = ASIDE * float(view.height) / (2 * view.fy);
    const float tx = std::clamp(at[0] / z, -aside, aside), ty = std::clamp(at[1] / z, -above, above);
    float bend[2][3], half[2][3];
    for (int j = 0; j < 3; j++) {
        bend[0][j] = view.fx / z * (axes[0][j] - tx * axes[2][j]);
        bend[1][j] = view.fy / z * (axes[1][j] - ty * axes[2][j]);
    }
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 3; j++)
            half[i][j] = bend[i][0] * covariance[j] + bend[i][1] * covariance[3 + j] + bend[i][2] * covariance[6 + j];
    const auto spread = [&](int i, int j) {
        return half[i][0] * bend[j][0] + half[i][1] * bend[j][1] + half[i][2] * bend[j][2];
    };
    const float xx = spread(0, 0) + BLUR, xy = spread(0, 1), yy = spread(1, 1) + BLUR, area = xx * yy - xy * xy;
    const float u = view.fx * at[0] / z + view.cx, v = view.fy * at[1] / z + view.cy;
    const float reach = std::sqrt(2 * std::log(alpha / FAINTEST)), wide = reach * std::sqrt(xx), high = reach * std::sqrt(yy);
    if (!(u + wide > 0 && u - wide < float(view.width) && v + high > 0 && v - high < float(view.height))) return false;
    seen = {z, u, v, yy / area, -xy / area, xx / area, alpha, 0, 0, 0, 0, 0};
    seen.left = std::max(0, int32_t(std::ceil(u - wide - 0.5f)));
    seen.right = std::min(view.width - 1, int32_t(std::floor(u + wide - 0.5f)));
    seen.top = std::max(0, int32_t(std::ceil(v - high - 0.5f)));
    seen.bottom = std::min(view.height - 1, int32_t(std::floor(v + high - 0.5f)));
    return true;
}

struct Gaussians {
    int64_t count;
    const float *means, *covariances, *alphas;
};

// Those that a camera sees, front to back.
std::vector<Seen> sorted(const View& view, const Gaussians& all) {
    std::vector<Seen> seen;
    for (int64_t i = 0; i < all.count; i++) {
        Seen one;
        if (!project(view, all.means + 3 * i, all.covariances + 9 * i, all.alphas[i], one)) continue;
        one.index = int32_t(i);
        seen.push_back(one);
    }
    std::stable_sort(seen.begin(), seen.end(), [](const Seen& a, const Seen& b) { return a.z < b.z; });
    return seen;
}

// Calls `tell` for every Gaussian at every pixel that it changes: its number, the pixel, its alpha there and the
// transmittance in front of it. Returns the transmittance of each pixel.
template <typename Tell> std::vector<float> lay(const View& view, const std::vector<Seen>& seen, Tell tell) {
    std::vector<float> transmittance(int64_t(view.width) * view.height, 1.0f); // negative once a pixel is done
    for (const Seen& one : seen)
        for (int32_t row = one.top; row <= one.bottom; row++) {
            const float dy = float(row) + 0.5f - one.v;
            for (int32_t column = one.left; column <= one.right; column++) {
                const int64_t pixel = int64_t(row) * view.width + column;
                if (transmittance[pixel] < 0) continue;
                const float dx = float(column) + 0.5f - one.u;
                const float power = 0.5f * (one.a * dx * dx + one.c * dy * dy) + one.b * dx * dy;
                const float alpha = std::min(STRONGEST, one.alpha * std::exp(-power));
                if (alpha < FAINTEST) continue;
                const float before = transmittance[pixel], after = before * (1 - alpha);
                transmittance[pixel] = after > OPAQUE ? after : -before;
                if (after > OPAQUE) tell(one.index, pixel, alpha, before);
            }
        }
    for (float& x : transmittance) x = std::fabs(x);
    return transmittance;
}

} // namespace

extern "C" {

// An image [height, width, 4] of colours and transmittance.
void mmpi_splat_image(const View* view, const Gaussians* all, const float* colors, float* image) {
    const auto add = [&](int64_t i, int64_t pixel, float alpha, float before) {
        for (int c = 0; c < 3; c++) image[4 * pixel + c] += before * alpha * colors[3 * i + c];
    };
    const auto transmittance = lay(*view, sorted(*view, *all), add);
    for (size_t p = 0; p < transmittance.size(); p++) image[4 * p + 3] = transmittance[p];
}

// Sums [count, 6] over the pixels of an image: of each Gaussian's weight times (error, 1), and, with J what a number of
// the image changes with the logit of its opacity, of (J error / (sum of all Gaussians' |J|), |J|). `rendered` is the
// image with its background, [height, width, 3].
void mmpi_splat_errors(const View* view, const Gaussians* all, const float* colors, const float* rendered,
                       const float* errors, float* sums) {
    const std::vector<Seen> seen = sorted(*view, *all);
    std::vector<float> front, total(int64_t(view->width) * view->height * 3, 0.0f);
    const auto walk = [&](auto use) {
        front.assign(total.size(), 0.0f);
        lay(*view, seen, [&](int64_t i, int64_t pixel, float alpha, float before) {
            for (int c = 0; c < 3; c++) {
                const int64_t at = 3 * pixel + c;
                front[at] += before * alpha * colors[3 * i + c];
                const float behind = (rendered[at] - front[at]) / (1 - alpha);
                const float change = alpha < STRONGEST ? alpha * (1 - all->alphas[i]) : 0.0f;
                use(6 * i + c, at, before * alpha, change * (before * colors[3 * i + c] - behind));
            }
        });
    };
    walk([&](int64_t, int64_t at, float, float slope) { total[at] += std::fabs(slope); });
    walk([&](int64_t sum, int64_t at, float weight, float slope) {
        float* own = sums + sum / 6 * 6;
        sums[sum] += weight * errors[at];
        if (sum % 6 == 0) own[3] += weight;
        own[4] += slope * errors[at] / std::max(total[at], 1e-6f);
        own[5] += std::fabs(slope);
    });
}
}
