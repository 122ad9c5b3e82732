// Adam on the rows of a table that a batch touched.
#include "parts.h"
#include "scene.h"
#include "table.h"

#include <cmath>
#include <type_traits>

namespace {

// Eight numbers, or the first of them; those in bfloat16 are the upper halves of floats, rounded to nearest even.
typedef uint16_t Halves __attribute__((vector_size(2 * OCTET)));
typedef uint32_t Words __attribute__((vector_size(4 * OCTET)));

template <typename To, typename From> To some(const From* from, int64_t count) {
    To x{};
    __builtin_memcpy(&x, from, count * sizeof *from);
    return x;
}

Octet widen(Halves halves) { return Octet(__builtin_convertvector(halves, Words) << 16); }

Halves narrow(Octet x) {
    const Words bits = Words(x);
    return __builtin_convertvector((bits + 0x7fff + ((bits >> 16) & 1)) >> 16, Halves);
}

Octet root(Octet x) {
    float each[OCTET];
    __builtin_memcpy(each, &x, sizeof each);
    for (float& number : each) number = std::sqrt(number);
    return load_octet(each);
}

// Adam on distinct rows; the empty brick and entries whose gradient is exactly 0 do not change. `moments`
// [T, 2, channels], means and uncentred variances, are in bfloat16.
void mmpi_adam_rows(int64_t begin, int64_t end, const int64_t* rows, int64_t channels, const float* grad, float* param,
                    uint16_t* moments, float beta1, float beta2, float correction, float eps, float rate) {
    for (int64_t i = begin; i < end; i++) {
        if (i + AHEAD < end) {
            prefetch_row(param + rows[i + AHEAD] * channels, channels);
            prefetch_row(moments + rows[i + AHEAD] * 2 * channels, 2 * channels);
        }
        if (rows[i] < BRICK) continue;
        const auto step = [&](int64_t first, auto count) {
            float* const value = param + rows[i] * channels + first;
            uint16_t *const mean = moments + rows[i] * 2 * channels + first, *const square = mean + channels;
            const Octet g = some<Octet>(grad + i * channels + first, count), x = some<Octet>(value, count);
            const Octet m = widen(some<Halves>(mean, count)), s = widen(some<Halves>(square, count));
            const auto touched = g != 0.0f;
            const Octet new_mean = touched ? m + (1 - beta1) * (g - m) : m;
            const Octet new_square = touched ? s * beta2 + (1 - beta2) * g * g : s;
            const Octet change = rate * (new_mean / (root(new_square) / correction + eps));
            const Octet new_value = touched ? x - change : x;
            const Halves means = narrow(new_mean), squares = narrow(new_square);
            __builtin_memcpy(value, &new_value, count * sizeof *value);
            __builtin_memcpy(mean, &means, count * sizeof *mean);
            __builtin_memcpy(square, &squares, count * sizeof *square);
        };
        int64_t first = 0;
        for (; first + OCTET <= channels; first += OCTET) step(first, std::integral_constant<int64_t, OCTET>{});
        for (; first < channels; first++) step(first, std::integral_constant<int64_t, 1>{});
    }
}

} // namespace

IN_PARTS(mmpi_adam_rows)
