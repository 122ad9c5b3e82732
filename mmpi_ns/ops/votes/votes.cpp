// Texels of the heads that cover samples, by the look-up of the march.
#include "blend.h"
#include "parts.h"

namespace {

constexpr int64_t TAPS = 8; // of a vote

// Votes on samples [begin, end), from begin * heads on; their number goes to the part's place in `counts`.
void mmpi_find_votes(int64_t begin, int64_t end, const Scene* scene, const float* origins, const float* directions,
                     const float* inverse_t, const int64_t* heads, int64_t* numbers, int64_t* rows, float* weights,
                     int64_t* counts) {
    const Rays rays{origins, directions, inverse_t, inverse_t, nullptr, nullptr}; // one a sample; ends are not read
    const int64_t H = scene->num_heads;
    std::vector<Votes> votes(H);
    int64_t size = begin * H;
    for (int64_t first = begin; first < end; first += WIDTH) {
        const Packet packet(rays, first, std::min<int64_t>(WIDTH, end - first));
        const IntLanes own = packet.each<IntLanes>([&](int64_t n) { return int32_t(heads[n]); });
        for (int64_t j = 0; j < H; j++) {
            const LocalRays local = j < scene->num_mpis ? LocalRays(scene->mpis[j], packet) : LocalRays();
            const Places places(*scene, packet, &local, j, packet.near);
            votes[j].place(scene->grids[j], places, own == int32_t(j), packet.there);
        }
        for (Votes& vote : votes) vote.look_up(*scene);
        for (int64_t j = 0; j < H; j++)
            votes[j].each(*scene, [&](int i, const Sample& texels) {
                numbers[size] = (first + i) * H + j;
                std::copy_n(texels.rows, TAPS, rows + size * TAPS);
                std::copy_n(texels.shares, TAPS, weights + size++ * TAPS);
            });
    }
    counts[this_part] = size - begin * H;
}

} // namespace

IN_PARTS(mmpi_find_votes)
