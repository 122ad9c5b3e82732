// What a brick is used for: the weights of the samples that read it, and the errors of their rays.
#include "parts.h"
#include "scene.h"

#include <algorithm>

namespace {

constexpr int64_t CELL = 4, CUBE = 8; // texels that a sample reads of one plane, and in the cube
constexpr int64_t CHUNK = 256;        // samples that are looked up together

// The larger one, and what is not a number.
void raise(float& peak, float weight) { peak = weight > peak || weight != weight ? weight : peak; }

struct Use {
    const int64_t* rows;
    const int32_t* positions;
    const int64_t* slots;
    const float *weights, *errors;
    int64_t width;
    float *peak, *gain;

    // Of samples [first, stop), at most a chunk, those that read rows [begin, end), which are those of bricks.
    template <int64_t TAPS> void note(int64_t begin, int64_t end, int64_t first, int64_t stop) const {
        const int64_t lowest = rows[begin] / BRICK, highest = rows[end - 1] / BRICK;
        const auto is_own = [&](int64_t brick) { return lowest <= brick && brick <= highest; };
        int64_t samples[CHUNK], size = 0, ray = 0;
        for (int64_t i = first; i < stop; i++) {
            bool reads = false;
            for (int64_t k = i * TAPS; k < (i + 1) * TAPS; k++) reads |= begin <= positions[k] && positions[k] < end;
            samples[size] = i, size += reads;
        }
        // Looked up apart from what depends on it: no memory is waited for after a wrong guess. Products are rounded
        // here, where no sum follows that they could be rounded with.
        float weight[CHUNK], share[CHUNK];
        int32_t bricks[CHUNK * TAPS];
        for (int64_t i = 0; i < size; i++) {
            const int64_t slot = slots[samples[i]];
            if (slot < ray * width || slot >= (ray + 1) * width) ray = slot / width;
            weight[i] = weights[slot];
            share[i] = weight[i] * errors[ray];
            for (int64_t k = 0; k < TAPS; k++)
                bricks[i * TAPS + k] = int32_t(rows[positions[samples[i] * TAPS + k]] / BRICK);
        }
        const int32_t* at = bricks;
        for (int64_t i = 0; i < size; i++) {
            if (gain && is_own(at[0])) gain[at[0]] += share[i];
            for (int64_t cell = 0; cell < TAPS; cell += CELL, at += CELL) {
                const bool same = at[0] == at[1] && at[0] == at[2] && at[0] == at[3]; // as of most
                for (int64_t k = 0; k < (same ? 1 : CELL); k++)
                    if (is_own(at[k])) raise(peak[at[k]], weight[i]);
            }
        }
    }
};

// Of samples that each read `taps` of the rows: raises the peaks of bricks to the largest weight of a sample that reads
// them, and adds weights times errors to the gains of the bricks of first texels. A part owns rows [begin, end), which
// are all of some bricks, and adds in the order of samples.
void mmpi_note_use(int64_t begin, int64_t end, const int64_t* rows, const int32_t* positions, int64_t count,
                   int64_t taps, const int64_t* slots, const float* weights, const float* errors, int64_t width,
                   float* peak, float* gain) {
    const Use use{rows, positions, slots, weights, errors, width, peak, gain};
    for (int64_t i = 0; begin < end && i < count; i += CHUNK) {
        const int64_t stop = std::min(count, i + CHUNK);
        taps == CELL ? use.note<CELL>(begin, end, i, stop) : use.note<CUBE>(begin, end, i, stop);
    }
}

} // namespace

IN_PARTS(mmpi_note_use)
