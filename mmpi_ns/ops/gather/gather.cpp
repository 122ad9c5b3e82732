// Sums along rays of weight times colour and features, and their gradients.
#include "parts.h"
#include "taps.h"

#include <vector>

namespace {

// The texels that samples read, and the samples' weights.
struct Taps {
    int64_t taps;
    const int32_t* positions;
    const float *shares, *weights;

    Sample sample(int64_t number) const {
        Sample x;
        x.taps = int(taps), x.weight = weights[number];
        for (int tap = 0; tap < taps; tap++)
            x.rows[tap] = positions[number * taps + tap], x.shares[tap] = shares[number * taps + tap];
        return x;
    }
};

// Sums over a ray's samples: weight times texel values, weight, weight times squared colour.
void gather(const Table& table, const std::vector<Sample>& samples, float* sums) {
    float mass = 0;
    Lanes squares{};
    for (int64_t first = 0; first < table.channels; first += WIDTH) {
        Lanes sum{};
        for (const Sample& sample : samples) {
            const Lanes value = activate(interpolate(table, sample, first), first).value;
            sum += sample.weight * value;
            if (first == 0) squares += sample.weight * value * value, mass += sample.weight;
        }
        for (int64_t c = first; c < std::min(table.channels, first + WIDTH); c++) sums[c] = sum[c - first];
    }
    sums[table.channels] = mass;
    for (int c = 0; c < COLORS; c++) sums[table.channels + 1 + c] = squares[c];
}

// Sums [R, channels + 4] of rays [begin, end), 0 of those that are not `chosen` (null: all). The memory of the next ray
// is prefetched.
void mmpi_gather_taps(int64_t begin, int64_t end, int64_t rows, int64_t channels, int64_t num_taps, const float* values,
                      const int32_t* positions, const float* shares, const int64_t* starts, const float* weights,
                      const bool* chosen, float* sums) {
    const Table table{values, rows, channels};
    const Taps taps{num_taps, positions, shares, weights};
    std::vector<Sample> samples[2];
    const auto prepare = [&](int64_t ray) {
        std::vector<Sample>& next = samples[ray & 1];
        next.clear();
        for (int64_t i = starts[ray]; i < starts[ray + 1] && (!chosen || chosen[ray]); i++) {
            next.push_back(taps.sample(i));
            prefetch(table, next.back());
        }
    };
    if (begin < end) prepare(begin);
    for (int64_t ray = begin; ray < end; ray++) {
        if (ray + 1 < end) prepare(ray + 1);
        gather(table, samples[ray & 1], sums + ray * (channels + 1 + COLORS));
    }
}

// Gradients of values [rows, channels] and of shares (null if not needed; added to what is there) and of weights [N] from
// those of the sums [R, padded] and, except for the weights, of the sums of colours and twice those of squared colours
// [R, 16], padded with zeros. Samples of rays that are not `chosen` have none.
// One thread owns rows [begin, end) and adds the samples in order: sums do not depend on the threads.
// The owner of a sample's first row writes the other gradients.
void mmpi_gather_back(int64_t begin, int64_t end, int64_t rows, int64_t channels, int64_t num_taps, int64_t num_rays,
                      const float* values, const int32_t* positions, const float* shares, const int64_t* starts,
                      const float* weights, const bool* chosen, const float* grad_sums, const float* grad_colors,
                      const float* grad_squares, float* grad_values, float* grad_shares, float* grad_weights) {
    const Table table{values, rows, channels};
    const Taps taps{num_taps, positions, shares, weights};
    const auto owns = [&](int32_t row) { return begin <= row && row < end; };
    if (grad_values) std::fill(grad_values + begin * channels, grad_values + end * channels, 0.0f);
    const int64_t padded = (channels + WIDTH - 1) / WIDTH * WIDTH, count = starts[num_rays];
    constexpr int64_t AHEAD = 6;
    int64_t ray = 0;
    for (int64_t n = 0; n < count; n++) {
        for (int64_t tap = 0; n + AHEAD < count && tap < num_taps; tap++) {
            const int32_t soon = positions[(n + AHEAD) * num_taps + tap];
            if (!owns(soon)) continue;
            table.prefetch(soon);
            if (!grad_values) continue;
            __builtin_prefetch(grad_values + soon * channels, 1);
            __builtin_prefetch(grad_values + (soon + 1) * channels - 1, 1);
        }
        while (n >= starts[ray + 1]) ray++;
        const int32_t* at = positions + n * num_taps;
        if ((chosen && !chosen[ray]) || std::none_of(at, at + num_taps, owns)) continue;
        const Sample sample = taps.sample(n);
        const bool is_first = owns(at[0]);
        Lanes total{};
        for (int64_t first = 0; first < channels; first += WIDTH) {
            const Texel texel = activate(interpolate(table, sample, first), first);
            Lanes slope = load(grad_sums + ray * padded + first);
            total += pick(IOTA < float(channels - first), slope * texel.value, Lanes{});
            if (first == 0) slope += load(grad_colors + ray * WIDTH) + load(grad_squares + ray * WIDTH) * texel.value;
            float down[WIDTH];
            store(down, sample.weight * slope * texel.slope);
            const int64_t size = std::min<int64_t>(WIDTH, channels - first);
            for (int tap = 0; grad_values && tap < num_taps; tap++)
                if (owns(at[tap])) add_row(grad_values + at[tap] * channels + first, down, sample.shares[tap], size);
            for (int tap = 0; is_first && grad_shares && tap < num_taps; tap++) {
                const float* read = values + at[tap] * channels + first;
                for (int64_t c = 0; c < size; c++) grad_shares[n * num_taps + tap] += read[c] * down[c];
            }
        }
        if (!is_first) continue;
        float sum = 0;
        for (int i = 0; i < WIDTH; i++) sum += total[i];
        grad_weights[n] = sum;
    }
}

} // namespace

IN_PARTS(mmpi_gather_taps)
IN_PARTS(mmpi_gather_back)
