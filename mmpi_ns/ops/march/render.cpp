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

    // What the next samples of sixteen rays in an MPI read, looked up and prefetched before it is needed.
    struct Ahead {
        IntLanes rows[CORNERS];
        Lanes fx, fy;
    };

    void look_ahead(int32_t k, const Walks<CELLS>& walk, Mask going, Ahead& to) const {
        IntLanes column, row;
        Lanes fx, fy;
        walk.cell(stacks[k], column, row, fx, fy);
        const IntLanes tile = pick(going, walk.brick * CORNERS, IntLanes{});
        column = pick(going, column, IntLanes{}), row = pick(going, row, IntLanes{});
        const Mask beyond_right = column == CELLS - 1, beyond_below = row == CELLS - 1;
        const bool right = any(beyond_right), below = any(beyond_below);
        const IntLanes first = gather(bricks, tile) * int32_t(BRICK);
        const auto neighbour = [&](int which) { return gather(bricks + which, tile) * int32_t(BRICK); };
        const IntLanes at = row * CELLS + column;
        const IntLanes beside = right ? pick(beyond_right, neighbour(1) - CELLS, first) : first;
        const IntLanes under = below ? pick(beyond_below, neighbour(2) - CELLS * CELLS, first) : first;
        IntLanes across = right ? pick(beyond_below, under - CELLS, beside) : under;
        if (right && below) across = pick(beyond_right & beyond_below, neighbour(3) - CELLS * CELLS - CELLS, pick(beyond_right, beside, under));
        else if (right) across = beside;
        to.rows[0] = pick(going, first + at, to.rows[0]), to.rows[1] = pick(going, beside + at + 1, to.rows[1]);
        to.rows[2] = pick(going, under + at + CELLS, to.rows[2]);
        to.rows[3] = pick(going, across + at + CELLS + 1, to.rows[3]);
        to.fx = pick(going, fx, to.fx), to.fy = pick(going, fy, to.fy);
        for (int i = 0; i < WIDTH; i++)
            __builtin_prefetch(scene.density + to.rows[0][i]), __builtin_prefetch(scene.density + to.rows[2][i]);
    }

    Lanes tau(int32_t k, const Walks<CELLS>& walk, Mask going, const Ahead& ahead, Reads& reads) const {
        const Lanes fx = ahead.fx, fy = ahead.fy;
        reads.taps = CORNERS;
        for (int tap = 0; tap < CORNERS; tap++) reads.rows[tap] = ahead.rows[tap];
        for (int tap = 0; tap < CORNERS; tap++)
            reads.shares[tap] = (tap & 1 ? fx : 1 - fx) * (tap >> 1 ? fy : 1 - fy);
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
