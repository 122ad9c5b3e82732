// Texels of the heads that cover samples, by the look-up of the march.
#include "blend.h"
#include "parts.h"
#include "taps.h"

namespace {

struct Place {
    float ndc[3];
    int64_t texel; // the nearest one; -1 outside of the head
};

// Votes on samples [begin, end), from begin * heads on; their number goes to the part's place in `counts`. Whether texels
// were trained is prefetched: heads have millions, and neighbouring samples other ones.
void mmpi_find_votes(int64_t begin, int64_t end, const Scene* scene, const float* origins, const float* directions,
                     const float* inverse_t, const int64_t* heads, int64_t* numbers, int64_t* rows, float* weights,
                     int64_t* counts) {
    const Rays rays{origins, directions, inverse_t, inverse_t, nullptr, nullptr}; // one a sample; ends are not read
    const int64_t H = scene->num_heads;
    std::vector<LocalRays> local(scene->num_mpis);
    std::vector<Place> places(WIDTH * H);
    int64_t size = begin * H;
    for (int64_t first = begin; first < end; first += WIDTH) {
        const int64_t some = std::min<int64_t>(WIDTH, end - first);
        const Packet packet(rays, first, some);
        for (int64_t k = 0; k < scene->num_mpis; k++) local[k] = LocalRays(scene->mpis[k], packet);
        for (int64_t i = first, pair = 0; i < first + some; i++)
            for (int64_t j = 0; j < H; j++, pair++) {
                Place& at = places[pair];
                const bool inside = place(*scene, packet, local, int(i - first), j, inverse_t[i], at.ndc);
                at.texel = inside ? nearest_texel(scene->grids[j], at.ndc) : -1;
                __builtin_prefetch(scene->touched + at.texel);
            }
        for (int64_t i = first, pair = 0; i < first + some; i++)
            for (int64_t j = 0; j < H; j++, pair++) {
                const Place& at = places[pair];
                if (j != heads[i] && (at.texel < 0 || !scene->touched[at.texel])) continue;
                Sample sample;
                sample.put(scene->grids[j], true, 0, at.ndc);
                numbers[size] = i * H + j;
                std::copy_n(sample.rows, sample.taps, rows + size * sample.taps);
                std::copy_n(sample.shares, sample.taps, weights + size++ * sample.taps);
            }
    }
    counts[this_part] = size - begin * H;
}

} // namespace

IN_PARTS(mmpi_find_votes)
