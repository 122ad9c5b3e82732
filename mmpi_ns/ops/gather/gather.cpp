// What rays gather of the texels along them, and its gradients. References in ops/gather/reference.py.
#include "taps.h"

#include <vector>

namespace {

// Taps of samples that are known: those of planes first, then those of the cube.
struct Taps {
    const int32_t* positions;
    const float* shares;
    int64_t count;
    float* grad_shares; // null where not wanted
};

// Sums over a ray's samples: weight times what their texels hold, weight, weight times squared colour.
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

void put_known(Sample& sample, const Taps* groups, int64_t number) {
    const bool in_cube = number >= groups[0].count;
    const Taps& group = groups[in_cube];
    sample.taps = in_cube ? 8 : 4;
    const int64_t at = (number - (in_cube ? groups[0].count : 0)) * sample.taps;
    for (int tap = 0; tap < sample.taps; tap++)
        sample.rows[tap] = group.positions[at + tap], sample.shares[tap] = group.shares[at + tap];
}

// Where the gradients of a sample's shares go.
float* grad_of_shares(const Taps* groups, int64_t number) {
    const bool in_cube = number >= groups[0].count;
    const Taps& group = groups[in_cube];
    return group.grad_shares ? group.grad_shares + (in_cube ? 8 * (number - groups[0].count) : 4 * number) : nullptr;
}

} // namespace

extern "C" {

// Sums [R, channels + 4] of rays [begin, end) at samples whose taps are known: `numbers` [R, S] says which are whose, -1
// for none. The next ray's memory is asked for before one is summed.
void mmpi_gather_taps(const float* values, int64_t rows, int64_t channels, const Taps* groups, const int32_t* numbers,
                      const float* weights, int64_t begin, int64_t end, int64_t slots, float* sums) {
    const Table table{values, rows, channels};
    std::vector<Sample> samples[2];
    const auto prepare = [&](int64_t ray) {
        std::vector<Sample>& found = samples[ray & 1];
        found.clear();
        for (int64_t slot = ray * slots; slot < (ray + 1) * slots; slot++) {
            if (numbers[slot] < 0) continue;
            Sample sample;
            put_known(sample, groups, numbers[slot]);
            sample.weight = weights[slot];
            found.push_back(sample);
            prefetch(table, sample);
        }
    };
    if (begin < end) prepare(begin);
    for (int64_t ray = begin; ray < end; ray++) {
        if (ray + 1 < end) prepare(ray + 1);
        gather(table, samples[ray & 1], sums + ray * (channels + 1 + COLORS));
    }
}

// Gradients of values [rows, channels] (added to what is there; null where not wanted), of shares (likewise, in the taps)
// and of weights [R, S] from those of the sums [R, padded] and, but for the weights, of the sums of colours and twice
// those of squared colours [R, 16], padded with zeros.
// Samples are taken in the order of `slots`, so sums do not depend on threads.
void mmpi_gather_back(const float* values, int64_t rows, int64_t channels, const Taps* groups, const int64_t* slots,
                      const bool* wanted, const float* weights, const float* grad_sums, const float* grad_colors,
                      const float* grad_squares, int64_t slots_per_ray, float* grad_values, float* grad_weights) {
    const Table table{values, rows, channels};
    const int64_t padded = (channels + WIDTH - 1) / WIDTH * WIDTH, count = groups[0].count + groups[1].count;
    constexpr int64_t AHEAD = 6;
    for (int64_t n = 0; n < count; n++) {
        if (n + AHEAD < count) {
            Sample soon;
            put_known(soon, groups, n + AHEAD);
            for (int tap = 0; tap < soon.taps; tap++) {
                table.prefetch(soon.rows[tap]);
                if (!grad_values) continue;
                __builtin_prefetch(grad_values + soon.rows[tap] * channels, 1);
                __builtin_prefetch(grad_values + (soon.rows[tap] + 1) * channels - 1, 1);
            }
        }
        const int64_t slot = slots[n], ray = slot / slots_per_ray;
        if (!wanted[ray]) continue;
        Sample sample;
        put_known(sample, groups, n);
        const float weight = weights[slot];
        Lanes total{};
        for (int64_t first = 0; first < channels; first += WIDTH) {
            const Texel texel = activate(interpolate(table, sample, first), first);
            Lanes slope = load(grad_sums + ray * padded + first);
            total += IOTA < float(channels - first) ? slope * texel.value : Lanes{};
            if (first == 0) slope += load(grad_colors + ray * WIDTH) + load(grad_squares + ray * WIDTH) * texel.value;
            float down[WIDTH];
            store(down, weight * slope * texel.slope);
            const int64_t size = std::min<int64_t>(WIDTH, channels - first);
            for (int tap = 0; grad_values && tap < sample.taps; tap++)
                add_row(grad_values + sample.rows[tap] * channels + first, down, sample.shares[tap], size);
            float* to_shares = grad_of_shares(groups, n);
            for (int tap = 0; to_shares && tap < sample.taps; tap++) {
                const float* read = values + sample.rows[tap] * channels + first;
                for (int64_t c = 0; c < size; c++) to_shares[tap] += read[c] * down[c];
            }
        }
        float sum = 0;
        for (int i = 0; i < WIDTH; i++) sum += total[i];
        grad_weights[slot] = sum;
    }
}
}
