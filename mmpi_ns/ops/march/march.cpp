// Rays through all heads at once: every head's samples come near to far, so the merge takes the nearest head at each
// step, and a ray ends where nothing behind it can matter. The reference is reference.py.
#include "cells.h"
#include "rays.h"

namespace {

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

// Raw densities to optical depths. Lanes beyond the block's size hold rubbish that nobody reads.
void finish(Run& run, float interval) {
    for (int j = run.size; j < WIDTH; j++) run.tau[j] = 0;
    const Lanes tau = softplus_lanes(load(run.tau)) * interval;
    store(run.tau, tau);
    store(run.pass, exp_lanes(-tau));
}

// The next samples of an MPI. Where nothing is stored there is nothing to see: with `skips` such samples are left out.
void fill_mpi(Run& run, const Scene& scene, const Rays& rays, int64_t ray, int64_t k, bool skips) {
    const Mpi& mpi = scene.mpis[k];
    const Grid& grid = scene.grids[k];
    const int64_t i = ray * scene.num_mpis + k;
    const float u = rays.u[2 * i], u_slope = rays.u[2 * i + 1], v = rays.v[2 * i], v_slope = rays.v[2 * i + 1];
    const float oz = rays.local_origins[3 * i + 2], dz = rays.local_directions[3 * i + 2];
    const float *biases = scene.biases + grid.bias, *table = scene.density;
    const int32_t* tiles = grid.tiles + grid.first_tile;
    int size = 0;
    while (2 * size < WIDTH && run.begin < run.count) {
        const int count = int(std::min<int64_t>(WIDTH - size, run.count - run.begin));
        const int64_t m = run.first - run.begin, first = grid.depth - 1 - m;
        const Lanes w = (float(m) - IOTA) * mpi.step + mpi.end;
        const Lanes x = (u + w * u_slope - mpi.u0) * mpi.u_scale - 1.0f, y = (v + w * v_slope - mpi.v0) * mpi.v_scale - 1.0f;
        float ndc[3][WIDTH], inverse_t[WIDTH];
        store(ndc[0], x), store(ndc[1], y), store(ndc[2], 1.0f - mpi.s_scale * (w - mpi.end));
        store(inverse_t, w * dz / (1.0f - w * oz));
        const PlaneCells at(grid, x, y, __builtin_convertvector(IOTA, IntLanes) + int32_t(first));
        for (int j = 0; j < count; j++) {
            float corners[4];
            if (!at.edge[j]) {
                const int32_t brick = tiles[at.tile[j]];
                if (skips && !brick) continue;
                const float* texel = table + int64_t(brick) * BRICK + at.texel[j];
                corners[0] = texel[0], corners[1] = texel[1], corners[2] = texel[8], corners[3] = texel[9];
            } else {
                const Corners found(grid, first + j, at.line[j], at.column[j]);
                if (skips && !found.stored) continue;
                for (int a = 0; a < 4; a++) corners[a] = table[found.row[a]];
            }
            const float fx = at.fx[j], fy = at.fy[j], gx = 1 - fx, gy = 1 - fy;
            run.tau[size] = gx * gy * corners[0] + fx * gy * corners[1] + gx * fy * corners[2] + fx * fy * corners[3] +
                            biases[first + j];
            run.plane[size] = int32_t(first + j);
            for (int a = 0; a < 3; a++) run.ndc[size][a] = ndc[a][j];
            run.inverse_t[size] = inverse_t[j];
            size++;
        }
        run.begin += count;
    }
    run.size = size;
    finish(run, mpi.interval);
}

void fill_cube(Run& run, const Scene& scene, const Rays& rays, int64_t ray, bool skips) {
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

void advance(Run& run, const Scene& scene, const Rays& rays, int64_t ray, int64_t head, bool skips) {
    if (++run.at < run.size) return;
    run.size = run.at = 0;
    if (run.begin == run.count) return;
    if (head < scene.num_mpis)
        fill_mpi(run, scene, rays, ray, head, skips);
    else
        fill_cube(run, scene, rays, ray, skips);
}

} // namespace

extern "C" {

// Marches rays [begin, end). What they keep is written one ray behind the other, from `starts[begin]` on; where a ray's
// samples begin, to `starts[ray]`; how many, to `kept[ray]`.
void mmpi_march(const Scene* scene, const Rays* rays, int64_t* starts, int64_t begin, int64_t end,
                float threshold, float fair_share, bool blends, int64_t* kept, float* skipped_total, float* dropped_mass,
                int32_t* heads, int32_t* planes, float* ndc, float* inverse_t, float* taus, float* skipped_before) {
    const int64_t H = scene->num_heads;
    std::vector<Run> runs(H);
    std::vector<int64_t> live(H);    // heads that have samples left,
    std::vector<float> nearest(H);   // and the inverse distance of the next one of each
    std::vector<float> votes;
    int64_t out = begin < end ? starts[begin] : 0;
    for (int64_t ray = begin; ray < end; ray++) {
        int64_t total = 0, alive = 0;
        for (int64_t h = 0; h < H; h++) {
            const int64_t count = rays->counts[ray * H + h];
            if (!count) continue;
            total += count;
            Run& run = runs[h];
            run.first = rays->first[ray * H + h];
            run.count = count;
            run.begin = 0;
            run.size = 0;
            run.at = -1;
            advance(run, *scene, *rays, ray, h, threshold > 0);
            if (!run.done()) nearest[alive] = run.next(), live[alive++] = h;
        }
        const Bounds bounds(threshold, fair_share, total);
        starts[ray] = out;
        float light = 1, skipped = 0, dropped = 0;
        while (alive) {
            int64_t best = 0;
            for (int64_t i = 1; i < alive; i++) // equal distances: the first head comes first
                best = nearest[i] > nearest[best] ? i : best;
            const int64_t h = live[best];
            Run& run = runs[h];
            const int at = run.at;
            if (light <= bounds.light) {
                dropped += light; // no less than what all the rest weighs
                break;
            }
            float tau = run.tau[at], pass = run.pass[at];
            if (blends) {
                tau = blended(*scene, *rays, ray, h, run.inverse_t[at], tau, votes);
                pass = std::exp(-tau);
            }
            const float weight = light * (1 - pass);
            if (weight > bounds.weight) {
                heads[out] = int32_t(h);
                planes[out] = run.plane[at];
                for (int a = 0; a < 3; a++) ndc[3 * out + a] = run.ndc[at][a];
                inverse_t[out] = run.inverse_t[at];
                taus[out] = tau;
                skipped_before[out] = skipped;
                out++;
            } else {
                skipped += tau;
                dropped += weight;
            }
            light *= pass;
            advance(run, *scene, *rays, ray, h, threshold > 0);
            if (!run.done()) {
                nearest[best] = run.next();
                continue;
            }
            alive--;
            for (int64_t i = best; i < alive; i++) live[i] = live[i + 1], nearest[i] = nearest[i + 1];
        }
        kept[ray] = out - starts[ray];
        skipped_total[ray] = skipped;
        dropped_mass[ray] = dropped;
    }
}

// Copies what rays [begin, end) kept into `width` slots each; the rest of the slots is 0.
void mmpi_pack(const int64_t* starts, const int64_t* kept, int64_t begin, int64_t end, int64_t width,
               const int32_t* heads, const int32_t* planes, const float* ndc, const float* inverse_t, const float* tau,
               const float* skipped_before, int64_t* to_heads, int64_t* to_planes, float* to_ndc, float* to_inverse_t,
               float* to_tau, float* to_skipped_before, bool* valid) {
    // Array by array, so that copies and zeros (most slots, where one ray keeps many) go a cache line at a time.
    const auto pack = [](const auto* from, int64_t size, int64_t room, auto* to) {
        std::copy_n(from, size, to);
        std::fill_n(to + size, room - size, 0);
    };
    for (int64_t ray = begin; ray < end; ray++) {
        const int64_t to = ray * width, from = starts[ray], size = kept[ray];
        pack(heads + from, size, width, to_heads + to);
        pack(planes + from, size, width, to_planes + to);
        pack(ndc + 3 * from, 3 * size, 3 * width, to_ndc + 3 * to);
        pack(inverse_t + from, size, width, to_inverse_t + to);
        pack(tau + from, size, width, to_tau + to);
        pack(skipped_before + from, size, width, to_skipped_before + to);
        std::fill_n(valid + to, size, true);
        std::fill_n(valid + to + size, width - size, false);
    }
}
}
