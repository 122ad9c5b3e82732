// Samples of training rays: one ray at a time, every head's samples near to far in blocks. The merge takes the nearest
// head at each step, and a ray terminates where the rest is negligible. Why not abreast: walk.h.
#include "parts.h"
#include "walk.h"

namespace {

// Positions of sixteen samples on planes of an MPI, and the texels at their lower corners.
struct PlaneCells {
    int32_t column[WIDTH], line[WIDTH], tile[WIDTH], texel[WIDTH], edge[WIDTH]; // edge: corners lie in several bricks
    float fx[WIDTH], fy[WIDTH];

    PlaneCells(const Grid& grid, Lanes x, Lanes y, IntLanes plane) {
        IntLanes lower_x, lower_y;
        Lanes fraction_x, fraction_y;
        cells(x, grid.width, lower_x, fraction_x);
        cells(y, grid.height, lower_y, fraction_y);
        const IntLanes in_x = lower_x & 7, in_y = lower_y & 7;
        store(column, lower_x), store(line, lower_y);
        store(tile, (plane * int32_t(grid.down) + (lower_y >> 3)) * int32_t(grid.across) + (lower_x >> 3));
        store(texel, (in_y << 3) + in_x);
        store(edge, (in_x == 7) | (in_y == 7));
        store(fx, fraction_x), store(fy, fraction_y);
    }
};

// One head's samples along one ray, looked up a block at a time.
struct Run {
    int64_t first, count, begin; // begin: samples before the next block
    int size, at;
    float tau[WIDTH], pass[WIDTH]; // optical depth, and e^-tau
    float inverse_t[WIDTH], ndc[WIDTH][3];
    int32_t plane[WIDTH];

    bool done() const { return at == size; }
    float next() const { return inverse_t[at]; }
};

// Raw densities to optical depths. Lanes beyond the block's size are undefined and unused.
void finish(Run& run, float interval) {
    for (int j = run.size; j < WIDTH; j++) run.tau[j] = 0;
    const Lanes tau = softplus_lanes(load(run.tau)) * interval;
    store(run.tau, tau);
    store(run.pass, exp_lanes(-tau));
}

// The next planes of an MPI that a ray intersects, and where.
struct Block {
    int count;
    int64_t first; // plane
    Lanes w, x, y; // disparities and NDC
    PlaneCells cells;

    Block(const Run& run, const Mpi& mpi, const Grid& grid, const Crossing& at, int ray, int most)
        : count(int(std::min<int64_t>(most, run.count - run.begin))), first(grid.depth - 1 - run.first + run.begin),
          w((float(run.first - run.begin) - IOTA) * mpi.step + mpi.end),
          x((at.u[ray] + w * at.u_slope[ray] - mpi.u0) * mpi.u_scale - 1.0f),
          y((at.v[ray] + w * at.v_slope[ray] - mpi.v0) * mpi.v_scale - 1.0f),
          cells(grid, x, y, truncated(IOTA) + int32_t(first)) {}
};

// The next samples of an MPI. With `skips`, samples without a stored texel, which are transparent, are skipped.
void fill_mpi(Run& run, const Scene& scene, const Crossing& at, int ray, int64_t k, bool skips) {
    const Mpi& mpi = scene.mpis[k];
    const Grid& grid = scene.grids[k];
    const float oz = at.origin[2][ray], dz = at.direction[2][ray];
    const float *biases = scene.biases + grid.bias, *table = scene.density;
    const int32_t* tiles = grid.tiles + grid.first_tile;
    int size = 0;
    while (2 * size < WIDTH && run.begin < run.count) {
        const Block block(run, mpi, grid, at, ray, WIDTH - size);
        const PlaneCells& cells = block.cells;
        float ndc[3][WIDTH], inverse_t[WIDTH];
        store(ndc[0], block.x), store(ndc[1], block.y), store(ndc[2], 1.0f - mpi.s_scale * (block.w - mpi.end));
        store(inverse_t, block.w * dz / (1.0f - block.w * oz));
        for (int j = 0; j < block.count; j++) {
            const int64_t plane = block.first + j;
            float corners[4];
            if (!cells.edge[j]) {
                const int32_t brick = tiles[cells.tile[j]];
                if (skips && !brick) continue;
                const float* texel = table + int64_t(brick) * BRICK + cells.texel[j];
                corners[0] = texel[0], corners[1] = texel[1], corners[2] = texel[8], corners[3] = texel[9];
            } else {
                const Corners around(grid, plane, cells.line[j], cells.column[j]);
                if (skips && !around.stored) continue;
                for (int a = 0; a < 4; a++) corners[a] = table[around.row[a]];
            }
            const float fx = cells.fx[j], fy = cells.fy[j], gx = 1 - fx, gy = 1 - fy;
            run.tau[size] = gx * gy * corners[0] + fx * gy * corners[1] + gx * fy * corners[2] + fx * fy * corners[3] +
                            biases[plane];
            run.plane[size] = int32_t(plane);
            for (int a = 0; a < 3; a++) run.ndc[size][a] = ndc[a][j];
            run.inverse_t[size] = inverse_t[j];
            size++;
        }
        run.begin += block.count;
    }
    run.size = size;
    finish(run, mpi.interval);
    if (run.begin == run.count) return;
    const Block next(run, mpi, grid, at, ray, WIDTH);
    for (int j = 0; j < next.count; j++)
        __builtin_prefetch(table + int64_t(tiles[next.cells.tile[j]]) * BRICK + next.cells.texel[j]);
}

void fill_cube(Run& run, const Scene& scene, const Packet& rays, int ray, bool skips) {
    const Cube& cube = *scene.cube;
    const Grid& grid = scene.grids[scene.num_mpis];
    while (run.size < WIDTH && run.begin < run.count) {
        const int32_t index = int32_t(run.first + run.begin++);
        const float t = (float(index) + 0.5f) * cube.step;
        const int j = run.size;
        place_in_cube(cube, rays, ray, t, run.ndc[j]);
        const Cell x(run.ndc[j][0], grid.width), y(run.ndc[j][1], grid.height), z(run.ndc[j][2], grid.depth);
        const Corners front(grid, z.lower, y.lower, x.lower), back(grid, z.lower + 1, y.lower, x.lower);
        if (skips && !front.stored && !back.stored) continue;
        run.size++;
        run.plane[j] = index;
        run.inverse_t[j] = 1 / t;
        run.tau[j] = blend(scene.density, front, x, y) * (1 - z.fraction) +
                     blend(scene.density, back, x, y) * z.fraction + cube.bias;
    }
    finish(run, cube.interval);
}

// Kept samples, one ray behind the other.
struct Samples {
    int64_t *heads, *planes;
    float *ndc, *inverse_t, *tau, *skipped_before;

    void keep(const Run& run, int64_t head, float depth, float skipped, int64_t& size) const {
        heads[size] = head, planes[size] = run.plane[run.at];
        for (int a = 0; a < 3; a++) ndc[3 * size + a] = run.ndc[run.at][a];
        inverse_t[size] = run.inverse_t[run.at], tau[size] = depth, skipped_before[size] = skipped;
        size++;
    }
};

class Training {
  public:
    Training(const Scene& scene, float threshold, float fair_share, bool blends)
        : scene(scene), threshold(threshold), fair_share(fair_share), blends(blends), runs(scene.num_heads),
          waiting(scene.num_heads), nearest(scene.num_heads), blending(scene), local(scene.num_mpis) {}

    // Marches one of sixteen rays.
    void march(const Packet& rays, const Crossings& crossings, int ray, const Samples& to, int64_t& size, float& skipped,
               float& dropped) {
        int64_t num_waiting = 0;
        if (blends) {
            same = rays.repeated(ray);
            for (int64_t k = 0; k < scene.num_mpis; k++) local[k] = crossings.mpis[k].repeated(ray);
        }
        for (int64_t h = 0; h < scene.num_heads; h++) {
            const bool in_cube = h == scene.num_mpis;
            Run& run = runs[h];
            run.count = (in_cube ? crossings.cube.count : crossings.mpis[h].count)[ray];
            if (!run.count) continue;
            run.first = (in_cube ? crossings.cube.first : crossings.mpis[h].first)[ray];
            run.begin = 0, run.size = 0, run.at = -1;
            advance(run, rays, crossings, ray, h);
            if (!run.done()) nearest[num_waiting] = run.next(), waiting[num_waiting++] = h;
        }
        const Bounds bounds = Bounds::exact(threshold, fair_share, crossings.total[ray]);
        float transmittance = 1;
        skipped = dropped = 0;
        while (num_waiting) {
            int64_t best = 0;
            for (int64_t i = 1; i < num_waiting; i++) // equal distances: the first head comes first
                best = nearest[i] > nearest[best] ? i : best;
            const int64_t h = waiting[best];
            Run& run = runs[h];
            if (is_terminated(transmittance, bounds.transmittance)) {
                dropped += transmittance; // bounds the weights of all the rest
                break;
            }
            const float tau = run.tau[run.at], pass = run.pass[run.at];
            const float weight = transmittance * (1 - pass);
            if (weight > bounds.weight)
                to.keep(run, h, tau, skipped, size);
            else
                skipped += tau, dropped += weight;
            transmittance *= pass;
            advance(run, rays, crossings, ray, h);
            if (!run.done()) {
                nearest[best] = run.next();
                continue;
            }
            num_waiting--;
            for (int64_t i = best; i < num_waiting; i++) waiting[i] = waiting[i + 1], nearest[i] = nearest[i + 1];
        }
    }

  private:
    const Scene& scene;
    const float threshold, fair_share;
    const bool blends;
    std::vector<Run> runs;
    std::vector<int64_t> waiting; // heads with further samples,
    std::vector<float> nearest; // and the inverse distance of the next one of each
    Blending blending;
    Packet same; // sixteen times the ray at hand, and that in the MPIs' axes
    std::vector<LocalRays> local;

    // The optical depths of a block of samples of a head.
    void blend(Run& run, int64_t head) {
        for (int j = run.size; j < WIDTH; j++) run.inverse_t[j] = 0;
        const auto axes = [&](int64_t k) -> const LocalRays& { return local[k]; };
        const Lanes tau = blending.blended(same, axes, head, load(run.inverse_t), load(run.tau),
                                           IOTA < float(run.size));
        store(run.tau, tau), store(run.pass, exp_lanes(-tau));
    }

    void advance(Run& run, const Packet& rays, const Crossings& crossings, int ray, int64_t head) {
        if (++run.at >= run.size) {
            run.size = run.at = 0;
            if (run.begin == run.count) return;
            if (head < scene.num_mpis)
                fill_mpi(run, scene, crossings.mpis[head], ray, head, threshold > 0);
            else
                fill_cube(run, scene, rays, ray, threshold > 0);
            if (blends && !run.done()) blend(run, head);
        }
    }
};

// Marches rays [begin, end), each of which keeps `room` samples at most. Kept samples are written one ray behind the
// other, from begin * room on; their number to kept[ray].
void mmpi_march(int64_t begin, int64_t end, const Scene* scene, const Rays* rays, int64_t room, float threshold,
                float fair_share, bool blends, int64_t* kept, int64_t* intersected, bool* covered, float* skipped_total,
                float* dropped_mass, const Samples* samples) {
    Training training(*scene, threshold, fair_share, blends);
    Crossings crossings;
    int64_t size = begin * room;
    for (int64_t first = begin; first < end; first += WIDTH) {
        const Packet packet(*rays, first, std::min<int64_t>(WIDTH, end - first));
        crossings.cross(*scene, *rays, packet);
        for (int64_t ray = first; ray < std::min(first + WIDTH, end); ray++) {
            kept[ray] = -size;
            training.march(packet, crossings, int(ray - first), *samples, size, skipped_total[ray], dropped_mass[ray]);
            kept[ray] += size;
            intersected[ray] = crossings.total[ray - first], covered[ray] = crossings.fully_covered[ray - first];
        }
    }
}

} // namespace

IN_PARTS(mmpi_march)
