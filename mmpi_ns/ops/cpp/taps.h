// The texels that a sample reads, and their values.
#pragma once
#include "scene.h"
#include "table.h"

struct Sample {
    int64_t rows[8];
    float shares[8];
    int taps = 0;
    float weight = 0;

    // At a place in a head: on one of its planes, or anywhere in the cube.
    void put(const Grid& grid, bool in_cube, int64_t plane, const float* ndc) {
        const Cell x(ndc[0], grid.width), y(ndc[1], grid.height), z(ndc[2], grid.depth);
        if (in_cube) return put(grid, z, y, x);
        put(grid, plane, y, x, 1);
    }

    // Between two planes.
    void put(const Grid& grid, const Cell& z, const Cell& y, const Cell& x) {
        put(grid, z.lower, y, x, 1 - z.fraction), put(grid, z.lower + 1, y, x, z.fraction);
    }

  private:
    void put(const Grid& grid, int64_t plane, const Cell& y, const Cell& x, float share) {
        const Corners corners(grid, plane, y.lower, x.lower);
        for (int i = 0; i < 4; i++) {
            rows[taps] = corners.row[i];
            shares[taps++] = (i & 1 ? x.fraction : 1 - x.fraction) * (i >> 1 ? y.fraction : 1 - y.fraction) * share;
        }
    }
};

inline void prefetch(const Table& table, const Sample& sample) {
    for (int tap = 0; tap < sample.taps; tap++) table.prefetch(sample.rows[tap]);
}

// Of a table of eight channels.
inline Octet interpolate(const Table& table, const Sample& sample) {
    Octet sum{};
    for (int tap = 0; tap < sample.taps; tap++) sum += sample.shares[tap] * table.octet(sample.rows[tap]);
    return sum;
}

// Channels from `first` on.
inline Lanes interpolate(const Table& table, const Sample& sample, int64_t first) {
    if (table.channels == OCTET) return join(interpolate(table, sample), Octet{});
    Lanes sum{};
    for (int tap = 0; tap < sample.taps; tap++)
        sum += sample.shares[tap] * table.read(sample.rows[tap] * table.channels + first);
    return sum;
}

constexpr int COLORS = 3; // channels that are colours; the others are features

struct Texel {
    Lanes value, slope;
};

// Colours are sigmoids and features hyperbolic tangents, of sixteen numbers of these channels. NaN stays NaN.
inline Texel activate(Lanes raw, Lanes channels) {
    const Mask is_color = channels < float(COLORS);
    const Lanes share = 1.0f / (1.0f + exp_lanes(pick(is_color, -raw, -2.0f * raw)));
    const Lanes rest = share * (1.0f - share), value = pick(is_color, share, 2.0f * share - 1.0f);
    return {pick(raw == raw, value, raw), pick(is_color, rest, 4.0f * rest)};
}

inline Texel activate(Lanes raw, int64_t first) { return activate(raw, IOTA + float(first)); }
