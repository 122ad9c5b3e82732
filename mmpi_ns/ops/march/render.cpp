// Rendering of rays from the bricks of training.
#include "parts.h"
#include "taps.h"
#include "walk.h"

namespace {

constexpr int CORNERS = 4;

// The tiles of the MPIs from which stored texels can be read, in the order of their columns.
struct Tiles {
    const Column* columns;
    const int32_t (*bricks)[CORNERS]; // of the tile itself, right of it, below it, and right below
};

struct Floats {
    static constexpr int CELLS = 8;
    static constexpr bool HAS_CUBE = true, ENDS_DARK = false;

    struct Reads {
        IntLanes rows[8];
        Lanes shares[8];
        int taps;
    };
    using Lookup = Sample;

    const Scene& scene;
    const Column* columns;
    const int32_t* bricks;
    const Table features;
    const int64_t channels;
    const float threshold, fair_share;
    const bool blends;
    std::vector<Stack> stacks;

    Floats(const Scene& scene, const Tiles& tiles, const Table& features, float threshold, float fair_share, bool blends)
        : scene(scene), columns(tiles.columns), bricks(tiles.bricks[0]), features(features), channels(features.channels),
          threshold(threshold), fair_share(fair_share), blends(blends) {
        int32_t column = 0;
        for (int64_t k = 0; k < scene.num_mpis; k++) {
            const Mpi& mpi = scene.mpis[k];
            const Grid& grid = scene.grids[k];
            const auto cells = [](int64_t texels) { return int32_t((texels - 1 + CELLS - 1) / CELLS); };
            const auto scale = [](float u_scale, int64_t texels) { return 0.5f * u_scale * float(texels - 1); };
            stacks.push_back({mpi.step, mpi.end, mpi.u0, mpi.v0, scale(mpi.u_scale, grid.width),
                              scale(mpi.v_scale, grid.height), int32_t(grid.depth), int32_t(grid.height),
                              int32_t(grid.width), cells(grid.height), cells(grid.width), column});
            column += (stacks[k].planes + WORD - 1) / WORD * stacks[k].down * stacks[k].across;
        }
    }

    Bounds bounds(int32_t samples) const { return Bounds::exact(threshold, fair_share, samples); }

    // Texels beyond the right and lower borders of a brick are in other bricks, which are looked up if a ray needs them.
    void look_ahead(int64_t k, const Walks<CELLS>& walk, Mask going, Reads& reads) const {
        constexpr int32_t LINE = CELLS, ALL = CELLS * CELLS; // texels
        IntLanes x, y;
        Lanes fx, fy;
        walk.cell(stacks[k], x, y, fx, fy);
        x = pick(going, x, IntLanes{}), y = pick(going, y, IntLanes{});
        const IntLanes tile = pick(going, walk.brick * CORNERS, IntLanes{});
        const auto brick = [&](int corner) { return gather(bricks + corner, tile) * int32_t(BRICK); };
        const Mask leaves_right = x == CELLS - 1, leaves_below = y == CELLS - 1;
        const bool right = any(leaves_right), below = any(leaves_below);
        IntLanes bases[CORNERS];
        bases[0] = bases[1] = bases[2] = brick(0);
        if (right) bases[1] = pick(leaves_right, brick(1) - LINE, bases[0]);
        if (below) bases[2] = pick(leaves_below, brick(2) - ALL, bases[0]);
        bases[3] = pick(leaves_right, bases[1], bases[2]);
        if (right && below) bases[3] = pick(leaves_right & leaves_below, brick(3) - LINE - ALL, bases[3]);
        reads.taps = CORNERS;
        for (int tap = 0; tap < CORNERS; tap++) {
            const IntLanes row = bases[tap] + (y + (tap >> 1)) * LINE + x + (tap & 1);
            const Lanes share = (tap & 1 ? fx : 1 - fx) * (tap >> 1 ? fy : 1 - fy);
            reads.rows[tap] = pick(going, row, reads.rows[tap]), reads.shares[tap] = pick(going, share, reads.shares[tap]);
        }
        for (const int tap : {0, 2})
            for (int i = 0; i < WIDTH; i++) __builtin_prefetch(scene.density + reads.rows[tap][i]);
    }

    Lanes tau(int32_t k, const Walks<CELLS>& walk, Mask going, const Reads& reads) const {
        const Lanes bias = gather(scene.biases + scene.grids[k].bias, pick(going, walk.plane, IntLanes{}));
        return softplus_lanes(raw(reads) + bias) * scene.mpis[k].interval;
    }

    Lanes cube_tau(IntLanes index, const Packet& rays, Mask going, Reads& reads) const {
        for (int tap = 0; tap < 8; tap++) reads.rows[tap] = IntLanes{}, reads.shares[tap] = Lanes{};
        reads.taps = 8;
        for (uint32_t lanes = bits(going); lanes; lanes &= lanes - 1) {
            const int i = __builtin_ctz(lanes);
            float ndc[3];
            Sample sample;
            place_in_cube(*scene.cube, rays, i, (float(index[i]) + 0.5f) * scene.cube->step, ndc);
            sample.put(scene.grids[scene.num_mpis], true, 0, ndc);
            for (int tap = 0; tap < 8; tap++)
                reads.rows[tap][i] = int32_t(sample.rows[tap]), reads.shares[tap][i] = sample.shares[tap];
        }
        return softplus_lanes(raw(reads) + scene.cube->bias) * scene.cube->interval;
    }

    void weighed(const Reads&, Lanes) const {}

    // The rows that one of the samples reads, prefetched.
    void look_up(const Reads& reads, int lane, Sample& sample) const {
        sample.taps = reads.taps;
        for (int tap = 0; tap < reads.taps; tap++)
            sample.rows[tap] = reads.rows[tap][lane], sample.shares[tap] = reads.shares[tap][lane];
        prefetch(features, sample);
    }

    Lanes colors(const Sample& sample, int64_t first) const {
        return activate(interpolate(features, sample, first), first).value;
    }

    Lanes colors(const Sample& a, const Sample& b) const {
        return activate(join(interpolate(features, a), interpolate(features, b)), EIGHT_TWICE).value;
    }

  private:
    Lanes raw(const Reads& reads) const {
        Lanes sum{};
        for (int tap = 0; tap < reads.taps; tap++)
            sum += reads.shares[tap] * gather(scene.density, reads.rows[tap]);
        return sum;
    }
};

void mmpi_render(int64_t begin, int64_t end, const Scene* scene, const Rays* rays, const Tiles* tiles,
               const float* features, int64_t rows, int64_t channels, float threshold, float fair_share, bool blends,
               const Outputs* to) {
    const Floats texels(*scene, *tiles, Table{features, rows, channels}, threshold, fair_share, blends);
    render(texels, *rays, begin, end, *to);
}

} // namespace

IN_PARTS(mmpi_render)
