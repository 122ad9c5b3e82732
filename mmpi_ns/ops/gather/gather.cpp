// Sums along rays of weight times colour and features, and their gradients.
#include "parts.h"
#include "taps.h"

#include <vector>

namespace {

// Rows and weights of the taps of samples: those of planes first, then those of the cube.
struct Taps {
    const int32_t* positions;
    const float* weights;
    int64_t count;
    float* grad_weights; // null: not needed
};

// The taps of one sample.
struct SampleTaps {
    int taps;
    const int32_t* positions;
    const float* weights;
    float* grad_weights;

    SampleTaps(const Taps* groups, int64_t number) {
        const bool in_cube = number >= groups[0].count;
        const Taps& group = groups[in_cube];
        taps = in_cube ? 8 : 4;
        const int64_t at = (number - (in_cube ? groups[0].count : 0)) * taps;
        positions = group.positions + at, weights = group.weights + at;
        grad_weights = group.grad_weights ? group.grad_weights + at : nullptr;
    }

    Sample sample(float weight) const {
        Sample x;
        x.taps = taps, x.weight = weight;
        for (int tap = 0; tap < taps; tap++) x.rows[tap] = positions[tap], x.shares[tap] = weights[tap];
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

// Sums [R, channels + 4] of rays [begin, end): `numbers` [R, S] is the sample in each slot, -1 if there is none. The
// memory of the next ray is prefetched.
void mmpi_gather_taps(int64_t begin, int64_t end, const float* values, int64_t rows, int64_t channels,
                      const Taps* groups, const int32_t* numbers, const float* weights, int64_t slots, float* sums) {
    const Table table{values, rows, channels};
    std::vector<Sample> samples[2];
    const auto prepare = [&](int64_t ray) {
        std::vector<Sample>& next = samples[ray & 1];
        next.clear();
        for (int64_t slot = ray * slots; slot < (ray + 1) * slots; slot++) {
            if (numbers[slot] < 0) continue;
            next.push_back(SampleTaps(groups, numbers[slot]).sample(weights[slot]));
            prefetch(table, next.back());
        }
    };
    if (begin < end) prepare(begin);
    for (int64_t ray = begin; ray < end; ray++) {
        if (ray + 1 < end) prepare(ray + 1);
        gather(table, samples[ray & 1], sums + ray * (channels + 1 + COLORS));
    }
}

// Gradients of values [rows, channels] (null if not needed), of the taps' weights (in the taps, added to what is there)
// and of weights [R, S] from those of the sums [R, padded] and, except for the weights, of the sums of
// colours and twice those of squared colours [R, 16], padded with zeros. Samples of rays that are not `chosen` have none.
// One thread owns rows [begin, end) and adds the samples in the order of `slots`: sums do not depend on the threads.
// The owner of a sample's first row writes the other gradients.
void mmpi_gather_back(int64_t begin, int64_t end, const float* values, int64_t rows, int64_t channels,
                      const Taps* groups, const int64_t* slots, const bool* chosen, const float* weights,
                      const float* grad_sums, const float* grad_colors, const float* grad_squares,
                      int64_t slots_per_ray, float* grad_values, float* grad_weights) {
    const Table table{values, rows, channels};
    const auto owns = [&](int32_t row) { return begin <= row && row < end; };
    if (grad_values) std::fill(grad_values + begin * channels, grad_values + end * channels, 0.0f);
    const int64_t padded = (channels + WIDTH - 1) / WIDTH * WIDTH, count = groups[0].count + groups[1].count;
    constexpr int64_t AHEAD = 6;
    for (int64_t n = 0; n < count; n++) {
        if (n + AHEAD < count) {
            const SampleTaps soon(groups, n + AHEAD);
            for (int tap = 0; tap < soon.taps; tap++) {
                if (!owns(soon.positions[tap])) continue;
                table.prefetch(soon.positions[tap]);
                if (!grad_values) continue;
                __builtin_prefetch(grad_values + soon.positions[tap] * channels, 1);
                __builtin_prefetch(grad_values + (soon.positions[tap] + 1) * channels - 1, 1);
            }
        }
        const SampleTaps at(groups, n);
        if (std::none_of(at.positions, at.positions + at.taps, owns)) continue;
        const int64_t slot = slots[n], ray = slot / slots_per_ray;
        if (!chosen[ray]) continue;
        const Sample sample = at.sample(weights[slot]);
        const bool is_first = owns(at.positions[0]);
        Lanes total{};
        for (int64_t first = 0; first < channels; first += WIDTH) {
            const Texel texel = activate(interpolate(table, sample, first), first);
            Lanes slope = load(grad_sums + ray * padded + first);
            total += IOTA < float(channels - first) ? slope * texel.value : Lanes{};
            if (first == 0) slope += load(grad_colors + ray * WIDTH) + load(grad_squares + ray * WIDTH) * texel.value;
            float down[WIDTH];
            store(down, sample.weight * slope * texel.slope);
            const int64_t size = std::min<int64_t>(WIDTH, channels - first);
            for (int tap = 0; grad_values && tap < at.taps; tap++)
                if (owns(at.positions[tap]))
                    add_row(grad_values + at.positions[tap] * channels + first, down, at.weights[tap], size);
            for (int tap = 0; is_first && at.grad_weights && tap < at.taps; tap++) {
                const float* read = values + at.positions[tap] * channels + first;
                for (int64_t c = 0; c < size; c++) at.grad_weights[tap] += read[c] * down[c];
            }
        }
        if (!is_first) continue;
        float sum = 0;
        for (int i = 0; i < WIDTH; i++) sum += total[i];
        grad_weights[slot] = sum;
    }
}

} // namespace

IN_PARTS(mmpi_gather_taps)
IN_PARTS(mmpi_gather_back)
