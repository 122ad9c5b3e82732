// Texels of the heads that cover samples, by the look-up of the march.
#include "blend.h"
#include "parts.h"

namespace {

// Votes on samples [begin, end), from begin * heads on; their number goes to the part's place in `counts`.
void mmpi_find_votes(int64_t begin, int64_t end, const Scene* scene, const float* origins, const float* directions,
                     const float* inverse_t, const int64_t* heads, int64_t* numbers, int64_t* rows, float* weights,
                     int64_t* counts) {
    const Rays rays{origins, directions, inverse_t, inverse_t, nullptr, nullptr}; // one a sample; ends are not read
    const int64_t H = scene->num_heads;
    std::vector<LocalRays> local(scene->num_mpis);
    Votes votes[WIDTH];
    int64_t size = begin * H;
    for (int64_t first = begin; first < end; first += WIDTH) {
        const int64_t some = std::min<int64_t>(WIDTH, end - first);
        const Packet packet(rays, first, some);
        for (int64_t k = 0; k < scene->num_mpis; k++) local[k] = LocalRays(scene->mpis[k], packet);
        for (int64_t i = 0; i < some; i++)
            votes[i].look_up(*scene, packet, local, int(i), heads[first + i], inverse_t[first + i]);
        for (int64_t i = 0; i < some; i++)
            for (const Votes::Vote& vote : votes[i].votes) {
                if (!Votes::counts(*scene, vote)) continue;
                const Sample& texels = vote.texels;
                numbers[size] = (first + i) * H + vote.head;
                std::copy_n(texels.rows, texels.taps, rows + size * texels.taps);
                std::copy_n(texels.shares, texels.taps, weights + size++ * texels.taps);
            }
    }
    counts[this_part] = size - begin * H;
}

} // namespace

IN_PARTS(mmpi_find_votes)
