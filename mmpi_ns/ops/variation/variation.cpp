// Total variation of texels with its gradient.
#include "parts.h"
#include "taps.h"

#include <vector>

namespace {

constexpr int64_t PART = 4096; // rows whose differences are summed together (PART of __init__.py)

// Neighbours of a brick.
struct Surroundings {
    int64_t head = -1;      // -1: none
    int64_t beside[6] = {}; // first rows of the bricks left, right, above, below, before, behind; 0: nothing is stored
    int64_t columns = 8, lines = 8; // of the brick that lie on the plane
};

bool holds(const Grid& grid, int64_t place) {
    return place >= grid.first_tile && place < grid.first_tile + grid.depth * grid.down * grid.across;
}

// `place` is the brick's tile (-1 for the empty brick), `head` the one that holds it, or a guess.
Surroundings around_brick(const Grid* grids, int64_t num_heads, int64_t place, int64_t head) {
    Surroundings around;
    if (place < 0) return around;
    for (around.head = std::max<int64_t>(head, 0); !holds(grids[around.head], place);)
        around.head = (around.head + 1) % num_heads;
    const Grid& grid = grids[around.head];
    const int64_t tile = place - grid.first_tile, across = grid.across, layer = across * grid.down;
    const int64_t x = tile % across, y = tile / across % grid.down, z = tile / layer;
    const bool inside[6] = {x > 0, x + 1 < across, y > 0, y + 1 < grid.down, z > 0, z + 1 < grid.depth};
    const int64_t steps[6] = {-1, 1, -across, across, -layer, layer};
    for (int i = 0; i < 6; i++) around.beside[i] = inside[i] ? grid.tiles[place + steps[i]] * BRICK : 0;
    around.columns = std::min<int64_t>(8, grid.width - 8 * x);
    around.lines = std::min<int64_t>(8, grid.height - 8 * y);
    return around;
}

// Rows of one head, each before those of its neighbours; a neighbour that is not stored is the row itself.
struct Group {
    int64_t head, size;
    int64_t rows[WIDTH][7];
};

void add_row(Group& group, const Surroundings& at, int64_t row) {
    const int64_t texel = row % BRICK, x = texel & 7, y = texel >> 3, *beside = at.beside;
    const auto other = [&](int64_t brick, int64_t shift) { return brick ? brick + texel + shift : row; };
    int64_t* to = group.rows[group.size++];
    to[0] = row;
    to[1] = x > 0 ? row - 1 : other(beside[0], 7);
    to[2] = x + 1 < at.columns ? row + 1 : other(beside[1], -7);
    to[3] = y > 0 ? row - 8 : other(beside[2], 56);
    to[4] = y + 1 < at.lines ? row + 8 : other(beside[3], -56);
    to[5] = other(beside[4], 0);
    to[6] = other(beside[5], 0);
}

// Adds scale * Huber(center - other) and its slope. NaN stays NaN.
void add_difference(Lanes center, Lanes other, float scale, Lanes& slope, Lanes& value) {
    const Lanes difference = center - other, below = pick(difference > 1.0f, splat(1), difference);
    const Lanes clamped = pick(below < -1.0f, splat(-1), below);
    slope += scale * clamped;
    value += scale * clamped * (difference - 0.5f * clamped);
}

// Slopes with the part along chroma (three colours less their mean) weighted `times` times more (weigh_chroma).
Lanes weigh_chroma(Lanes slope, float times) {
    const float mean = (slope[0] + slope[1] + slope[2]) / COLORS;
    return pick(IOTA < float(COLORS), slope + times * (slope - mean), slope);
}

// Lanes are channels, sixteen at a time. `grad` has room for sixteen numbers more than it takes.
Lanes vary(const Table& table, const Group& group, const float* scale, float chroma, float* grad) {
    Lanes total{};
    const int64_t channels = table.channels;
    for (int64_t i = 0; i < group.size; i++)
        for (int64_t first = 0; first < channels; first += WIDTH) {
            Lanes slope{}, value{};
            const Lanes center = table.read(group.rows[i][0] * channels + first);
            for (int k = 0; k < 6; k++)
                add_difference(center, table.read(group.rows[i][k + 1] * channels + first), scale[k / 2], slope, value);
            if (chroma > 0 && first == 0) slope = weigh_chroma(slope, chroma);
            store(grad + i * channels + first, slope); // the next row overwrites what lies beyond this one
            total += pick(IOTA < float(channels - first), value, Lanes{});
        }
    return total;
}

// Huber loss of the differences of texels with their stored neighbours, and its gradient [count, channels], which holds
// neighbours fixed. Works on parts [begin, end) of PART rows each and writes the loss of each. Rows of a brick should
// come together. `places` names the tile of every brick, `scales` are those of x, y and z of each head, `chroma` is for
// weigh_chroma.
void mmpi_total_variation(int64_t begin, int64_t end, const int64_t* rows, int64_t count, int64_t channels,
                          const float* numbers, int64_t table_rows, const Grid* grids, int64_t num_heads,
                          const int64_t* places, const float* scales, float chroma, float* grad, double* totals) {
    const Table table{numbers, table_rows, channels};
    std::vector<float> scratch(WIDTH * channels + WIDTH);
    Surroundings at;
    int64_t brick = -1;
    for (int64_t part = begin; part < end; part++) {
        const int64_t stop = std::min(count, (part + 1) * PART);
        int64_t next = part * PART, first[2];
        Group groups[2];
        // The next rows of one head, with their memory prefetched.
        const auto find = [&](int which) {
            Group& group = groups[which];
            first[which] = next;
            group.size = 0;
            for (; group.size < WIDTH && next < stop; next++) {
                if (rows[next] / BRICK != brick) {
                    brick = rows[next] / BRICK;
                    at = around_brick(grids, num_heads, places[brick], at.head);
                }
                if (group.size && at.head != group.head) return;
                group.head = at.head;
                add_row(group, at, rows[next]);
                for (int64_t row : group.rows[group.size - 1]) table.prefetch(row);
            }
        };
        double total = 0;
        find(0);
        for (int now = 0; groups[now].size; now = 1 - now) {
            find(1 - now);
            const Group& group = groups[now];
            float* to = grad + first[now] * channels;
            if (group.head < 0) { // the empty brick
                std::fill(to, to + group.size * channels, 0.0f);
                continue;
            }
            const float each[3] = {scales[3 * group.head] / 6, scales[3 * group.head + 1] / 6,
                                   scales[3 * group.head + 2] / 6};
            const Lanes value = vary(table, group, each, chroma, scratch.data());
            std::copy(scratch.data(), scratch.data() + group.size * channels, to);
            for (int i = 0; i < WIDTH; i++) total += value[i];
        }
        totals[part] = total;
    }
}

} // namespace

IN_PARTS(mmpi_total_variation)
