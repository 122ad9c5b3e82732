// What rays show, from planes to sums without anything kept between: sixteen rays side by side through all heads, near to
// far, until each is opaque; then what the samples that weigh enough hold, ray by ray. The reference is reference.py.
#include "rays.h"
#include "taps.h"
#include "walks.h"

namespace {

constexpr int CELLS = 8, CORNERS = 4;

// The tiles of the MPIs from which something can be read, in the order of their columns.
struct Tiles {
    const Column* columns;
    const int32_t (*bricks)[CORNERS]; // of the tile itself, right of it, below it, and right below
};

struct Outputs {
    float *gathered, *mass, *transmittance, *accumulation, *inverse_t, *winner, *dropped; // [R, C], [R, 1]
};

// A sample that weighs enough.
struct Seen {
    Sample sample;
    float inverse_t;
    int32_t head;
};

// What sixteen samples of a head read.
struct Reads {
    IntLanes rows[8];
    Lanes shares[8];
    int taps;
};

struct CubeWalks {
    IntLanes index, last;
    Lanes inverse_t; // as in Walks

    void arrive(const Cube& cube, Mask going) {
        const Lanes here = 1 / ((real(index) + 0.5f) * cube.step);
        inverse_t = pick(going, pick(index <= last, here, splat(-1)), inverse_t);
    }
};

// Marches sixteen rays, and sixteen others after them.
class Marcher {
  public:
    Marcher(const Scene& scene, const Rays& rays, const Tiles& tiles, const Table& features, float threshold,
            float fair_share, bool blends)
        : scene(scene), rays(rays), tiles(tiles), features(features), threshold(threshold), fair_share(fair_share),
          blends(blends), walks(scene.num_mpis), masses(scene.num_heads) {
        int32_t column = 0;
        for (int64_t k = 0; k < scene.num_mpis; k++) {
            const Mpi& mpi = scene.mpis[k];
            const Grid& grid = scene.grids[k];
            const auto cells = [](int64_t texels) { return int32_t((texels - 1 + CELLS - 1) / CELLS); };
            stacks.push_back({mpi.step, mpi.end, int32_t(grid.depth), int32_t(grid.height), int32_t(grid.width),
                              cells(grid.height), cells(grid.width), column});
            column += (stacks[k].planes + WORD - 1) / WORD * stacks[k].down * stacks[k].across;
        }
    }

    void show(int64_t ray, int64_t some, const Outputs& to) {
        begin(ray, some);
        walk_abreast(
            int32_t(scene.num_heads), [&](int32_t h) { return h < scene.num_mpis ? walks[h].inverse_t : cube.inverse_t; },
            [&] { return light <= least_light; }, [&](int32_t h, Mask going) { take(h, going); });
        Mask rest{}; // rays that end before their last sample
        for (const auto& walk : walks) rest |= walk.inverse_t >= 0;
        rest |= cube.inverse_t >= 0;
        dropped += pick(rest, light, Lanes{}); // no less than what the rest weighs
        for (int64_t i = 0; i < some; i++) {
            sum(seen[i], ray + i, to);
            to.transmittance[ray + i] = light[i], to.accumulation[ray + i] = 1 - light[i];
            to.dropped[ray + i] = dropped[i];
        }
    }

  private:
    const Scene& scene;
    const Rays& rays;
    const Tiles& tiles;
    const Table& features;
    const float threshold, fair_share;
    const bool blends;
    std::vector<Stack> stacks;
    std::vector<Walks<CELLS>> walks;
    CubeWalks cube;
    std::vector<Seen> seen[WIDTH]; // of each ray, front to back
    int64_t numbers[WIDTH];        // of the rays; those beyond the last one are its copies, and show nothing
    Lanes light, dropped, least_weight, least_light;
    std::vector<float> votes, masses;

    template <typename To, typename F> To of_rays(F f) const {
        return each_lane<To>(truncated(IOTA), [&](int32_t i) { return f(numbers[i]); });
    }

    void begin(int64_t ray, int64_t some) {
        for (int64_t i = 0; i < WIDTH; i++) numbers[i] = ray + std::min(i, some - 1), seen[i].clear();
        light = splat(1), dropped = Lanes{}, cube.inverse_t = splat(-1);
        const Mask there = IOTA < float(some);
        const auto samples = [&](int64_t r) {
            int64_t all = 0;
            for (int64_t h = 0; h < scene.num_heads; h++) all += rays.counts[r * scene.num_heads + h];
            return all;
        };
        least_weight = of_rays<Lanes>([&](int64_t r) { return Bounds(threshold, fair_share, samples(r)).weight; });
        least_light = of_rays<Lanes>([&](int64_t r) { return Bounds(threshold, fair_share, samples(r)).light; });
        for (int64_t h = 0; h < scene.num_heads; h++) {
            const int64_t H = scene.num_heads;
            const IntLanes first = of_rays<IntLanes>([&](int64_t r) { return int32_t(rays.first[r * H + h]); });
            const IntLanes count = of_rays<IntLanes>([&](int64_t r) { return int32_t(rays.counts[r * H + h]); });
            if (h < scene.num_mpis)
                begin(h, stacks[h].planes - 1 - first, count, there);
            else
                cube.index = first, cube.last = first + count - 1, cube.arrive(*scene.cube, there);
        }
    }

    void begin(int64_t k, IntLanes first, IntLanes count, Mask there) {
        const int64_t K = scene.num_mpis;
        const Mpi& mpi = scene.mpis[k];
        const Grid& grid = scene.grids[k];
        Walks<CELLS>& walk = walks[k];
        const auto read = [&](const float* table, int64_t stride, int64_t at) {
            return of_rays<Lanes>([&](int64_t r) { return table[(r * K + k) * stride + at]; });
        };
        const Lanes slope_u = read(rays.u, 2, 1), slope_v = read(rays.v, 2, 1);
        const float x_scale = 0.5f * mpi.u_scale * float(grid.width - 1), y_scale = 0.5f * mpi.v_scale * float(grid.height - 1);
        walk.x_last = (read(rays.u, 2, 0) + mpi.end * slope_u - mpi.u0) * x_scale;
        walk.y_last = (read(rays.v, 2, 0) + mpi.end * slope_v - mpi.v0) * y_scale;
        walk.x_step = -mpi.step * slope_u * x_scale, walk.y_step = -mpi.step * slope_v * y_scale;
        walk.oz = read(rays.local_origins, 3, 2), walk.dz = read(rays.local_directions, 3, 2);
        walk.last = first + count - 1;
        walk.begin(tiles.columns, stacks[k], first, there);
    }

    // Rays of `going` take their next sample of one head.
    void take(int32_t h, Mask going) {
        const bool in_cube = h == scene.num_mpis;
        Reads reads;
        Lanes raw{}, inverse_t = in_cube ? cube.inverse_t : walks[h].inverse_t;
        in_cube ? look_up_cube(reads, going) : look_up(h, reads, going);
        for (int tap = 0; tap < reads.taps; tap++)
            raw += reads.shares[tap] * each_lane<Lanes>(reads.rows[tap], [this](int32_t row) { return scene.density[row]; });
        const float* biases = in_cube ? nullptr : scene.biases + scene.grids[h].bias;
        raw += in_cube ? splat(scene.cube->bias)
                       : each_lane<Lanes>(pick(going, walks[h].plane, IntLanes{}), [&](int32_t l) { return biases[l]; });
        Lanes tau = softplus_lanes(raw) * (in_cube ? scene.cube->interval : scene.mpis[h].interval);
        for (uint32_t lanes = blends ? bits(going) : 0; lanes; lanes &= lanes - 1) {
            const int i = __builtin_ctz(lanes);
            tau[i] = blended(scene, rays, numbers[i], h, inverse_t[i], tau[i], votes);
        }
        const Lanes pass = pick(going, exp_lanes(-tau), splat(1)), weight = light * (1 - pass);
        const Mask kept = going & (weight > least_weight);
        keep(h, reads, weight, inverse_t, kept);
        dropped += pick(kept, Lanes{}, weight);
        light *= pass;
        if (in_cube)
            cube.index -= going, cube.arrive(*scene.cube, going);
        else
            walks[h].next(tiles.columns, stacks[h], going);
    }

    void look_up(int32_t k, Reads& reads, Mask going) const {
        const Walks<CELLS>& walk = walks[k];
        IntLanes column, row;
        Lanes fx, fy;
        walk.cell(stacks[k], column, row, fx, fy);
        const IntLanes tile = pick(going, walk.brick, IntLanes{});
        const int32_t* bricks = tiles.bricks[0];
        reads.taps = CORNERS;
        for (int tap = 0; tap < CORNERS; tap++) {
            const IntLanes x = pick(going, column, IntLanes{}) + (tap & 1), y = pick(going, row, IntLanes{}) + (tap >> 1);
            const IntLanes at = tile * CORNERS + (y >> 3) * 2 + (x >> 3);
            const IntLanes brick = each_lane<IntLanes>(at, [&](int32_t i) { return bricks[i]; });
            reads.rows[tap] = brick * int32_t(BRICK) + ((y & 7) << 3) + (x & 7);
            reads.shares[tap] = (tap & 1 ? fx : 1 - fx) * (tap >> 1 ? fy : 1 - fy);
        }
    }

    void look_up_cube(Reads& reads, Mask going) const {
        for (int tap = 0; tap < 8; tap++) reads.rows[tap] = IntLanes{}, reads.shares[tap] = Lanes{};
        reads.taps = 8;
        for (uint32_t lanes = bits(going); lanes; lanes &= lanes - 1) {
            const int i = __builtin_ctz(lanes);
            float ndc[3];
            Sample sample;
            place_in_cube(*scene.cube, rays, numbers[i], (float(cube.index[i]) + 0.5f) * scene.cube->step, ndc);
            sample.put(scene.grids[scene.num_mpis], true, 0, ndc);
            for (int tap = 0; tap < 8; tap++)
                reads.rows[tap][i] = int32_t(sample.rows[tap]), reads.shares[tap][i] = sample.shares[tap];
        }
    }

    // Notes the samples that weigh enough, and asks for what they hold.
    void keep(int32_t h, const Reads& reads, Lanes weight, Lanes inverse_t, Mask kept) {
        for (uint32_t lanes = bits(kept); lanes; lanes &= lanes - 1) {
            const int i = __builtin_ctz(lanes);
            seen[i].emplace_back();
            Seen& made = seen[i].back();
            for (int tap = 0; tap < reads.taps; tap++)
                made.sample.rows[tap] = reads.rows[tap][i], made.sample.shares[tap] = reads.shares[tap][i];
            made.sample.taps = reads.taps, made.sample.weight = weight[i];
            made.inverse_t = inverse_t[i], made.head = h;
            prefetch(features, made.sample);
        }
    }

    // What a ray gathered, the inverse distance at half of it, and the head that gave most.
    void sum(const std::vector<Seen>& samples, int64_t ray, const Outputs& to) {
        const int64_t C = features.channels;
        for (int64_t first = 0; first < C; first += WIDTH) {
            Lanes total{};
            for (const Seen& s : samples)
                total += s.sample.weight * activate(interpolate(features, s.sample, first), first).value;
            for (int64_t c = first; c < std::min(C, first + WIDTH); c++) to.gathered[ray * C + c] = total[c - first];
        }
        std::fill(masses.begin(), masses.end(), 0.0f);
        float mass = 0, passed = 0;
        for (const Seen& s : samples) mass += s.sample.weight, masses[s.head] += s.sample.weight;
        to.mass[ray] = mass, to.inverse_t[ray] = 0;
        to.winner[ray] = float(std::max_element(masses.begin(), masses.end()) - masses.begin());
        for (size_t n = 0; n < samples.size() && mass > 0; n++) {
            to.inverse_t[ray] = samples[n].inverse_t;
            if ((passed += samples[n].sample.weight) >= 0.5f * mass) break;
        }
    }
};

} // namespace

extern "C" {

void mmpi_show(const Scene* scene, const Rays* rays, const Tiles* tiles, const float* features, int64_t rows,
               int64_t channels, float threshold, float fair_share, bool blends, int64_t begin, int64_t end,
               const Outputs* to) {
    const Table table{features, rows, channels};
    Marcher marcher(*scene, *rays, *tiles, table, threshold, fair_share, blends);
    for (int64_t ray = begin; ray < end; ray += WIDTH) marcher.show(ray, std::min<int64_t>(WIDTH, end - ray), *to);
}
}
