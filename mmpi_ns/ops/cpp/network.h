// Colour networks on blocks of samples. Matrices are row-major, a row a sample, and lanes run along rows; rows are padded
// with zeros to whole lanes.
#pragma once
#include "lanes.h"

#include <vector>

constexpr int ROWS = 32; // samples of a block

inline int64_t padded(int64_t count) { return (count + WIDTH - 1) / WIDTH * WIDTH; }

// Zeros that begin at a cache line.
class Buffer {
    std::vector<Lanes> memory;

  public:
    explicit Buffer(int64_t count) : memory(padded(count) / WIDTH) {}
    float* data() { return reinterpret_cast<float*>(memory.data()); }
    const float* data() const { return reinterpret_cast<const float*>(memory.data()); }
};

struct Matrix {
    float* numbers;
    int64_t stride; // between rows

    float* row(int64_t i) const { return numbers + i * stride; }
};

// to[m] += sum_k a(m, k) b[k] for M rows of L lanes, a(m, k) being a[m * down + k * along].
template <int M, int L>
__attribute__((always_inline)) inline void multiply_tile(const float* a, int64_t down, int64_t along, Matrix b, int64_t depth, Matrix to) {
    Lanes sums[M][L];
    for (int m = 0; m < M; m++)
        for (int l = 0; l < L; l++) sums[m][l] = load(to.row(m) + l * WIDTH);
    for (int64_t k = 0; k < depth; k++) {
        Lanes x[L];
        for (int l = 0; l < L; l++) x[l] = load(b.row(k) + l * WIDTH);
        for (int m = 0; m < M; m++)
            for (int l = 0; l < L; l++) sums[m][l] += a[m * down + k * along] * x[l];
    }
    for (int m = 0; m < M; m++)
        for (int l = 0; l < L; l++) store(to.row(m) + l * WIDTH, sums[m][l]);
}

template <int L>
void multiply_columns(const float* a, int64_t down, int64_t along, Matrix b, int64_t depth, Matrix to, int64_t rows) {
#ifdef __AVX512F__
    constexpr int TILE = 8; // sums that the registers hold: 8 x 2 of 32
#else
    constexpr int TILE = 2;
#endif
    int64_t m = 0;
    const auto rest = [&](int64_t i) { return Matrix{to.row(i), to.stride}; };
    for (; m + TILE <= rows; m += TILE) multiply_tile<TILE, L>(a + m * down, down, along, b, depth, rest(m));
    for (; m < rows; m++) multiply_tile<1, L>(a + m * down, down, along, b, depth, rest(m));
}

// to += A b, A being [rows, depth] with a step of `down` between rows and of `along` between columns.
inline void multiply(const float* a, int64_t down, int64_t along, Matrix b, int64_t depth, Matrix to, int64_t rows,
                     int64_t columns) {
    int64_t first = 0;
    const auto right = [&](Matrix x) { return Matrix{x.numbers + first, x.stride}; };
    for (; first + 2 * WIDTH <= columns; first += 2 * WIDTH)
        multiply_columns<2>(a, down, along, right(b), depth, right(to), rows);
    if (first < columns) multiply_columns<1>(a, down, along, right(b), depth, right(to), rows);
}

struct Network {
    int64_t channels, frequencies, width; // features, octaves of the position encoding, width of the hidden layers
    const float *first, *second, *second_bias, *third, *third_bias;
    // first: [width, channels + 3 (1 + 2 frequencies)]; what directions and the bias add to that layer comes apart
};

// A network's weights as blocks take them: [in, out].
struct Layers {
    Network net;
    int64_t inputs, units;
    Buffer first_buffer, second_buffer, third_buffer, bias_buffer;
    Matrix first, second, third; // [inputs, units], [units, units], [units, 4]

    explicit Layers(const Network& net)
        : net(net), inputs(net.channels + 3 * (1 + 2 * net.frequencies)), units(padded(net.width)),
          first_buffer(inputs * units), second_buffer(units * units), third_buffer(units * 4), bias_buffer(units),
          first{first_buffer.data(), units}, second{second_buffer.data(), units}, third{third_buffer.data(), 4} {
        for (int64_t j = 0; j < net.width; j++) {
            for (int64_t i = 0; i < inputs; i++) first.row(i)[j] = net.first[j * inputs + i];
            for (int64_t i = 0; i < net.width; i++) second.row(i)[j] = net.second[j * net.width + i];
            for (int a = 0; a < 3; a++) third.row(j)[a] = net.third[a * net.width + j];
            bias_buffer.data()[j] = net.second_bias[j];
        }
    }
    Layers(const Layers&) = delete;
};

// What a block of samples passes through the layers.
struct Block {
    Buffer memory;
    Matrix x, encoded, hidden, second; // [ROWS, whole lanes of features], [inputs - channels, ROWS], [ROWS, units] twice
    float position[3][ROWS] = {};
    float colors[3][ROWS] = {};

    explicit Block(const Layers& layers)
        : memory(ROWS * (padded(layers.net.channels) + layers.inputs - layers.net.channels + 2 * layers.units)),
          x{memory.data(), padded(layers.net.channels)}, encoded{x.row(ROWS), ROWS},
          hidden{encoded.row(layers.inputs - layers.net.channels), layers.units},
          second{hidden.row(ROWS), layers.units} {}
};

// (x, sin 2^i pi x, cos 2^i pi x) in the order of reference.positional_encoding, a row an input.
inline void encode(int64_t frequencies, Block& block) {
    for (int a = 0; a < 3; a++)
        for (int first = 0; first < ROWS; first += WIDTH) {
            const Lanes position = load(block.position[a] + first);
            const auto put = [&](int64_t place, Lanes numbers) { store(block.encoded.row(place + a) + first, numbers); };
            Lanes sine, cosine;
            sincos_turn(least(most(position, splat(-1)), splat(1)), sine, cosine);
            put(0, position);
            for (int64_t i = 0; i < frequencies; i++) {
                put(3 + 3 * i, sine);
                put(3 + 3 * (frequencies + i), cosine);
                const Lanes twice = 2.0f * sine * cosine;
                cosine = 1.0f - 2.0f * sine * sine;
                sine = twice;
            }
        }
}

// What is not a number stays so.
inline void relu(Matrix x, int64_t columns) {
    for (int64_t i = 0; i < ROWS; i++)
        for (int64_t c = 0; c < columns; c += WIDTH) {
            const Lanes value = load(x.row(i) + c);
            store(x.row(i) + c, value < 0 ? Lanes{} : value);
        }
}

// From features, positions and what `hidden` holds at first (directions and bias) to both hidden layers.
inline void run_hidden(const Layers& layers, Block& block) {
    const int64_t units = layers.units, channels = layers.net.channels;
    encode(layers.net.frequencies, block);
    multiply(block.x.numbers, block.x.stride, 1, layers.first, channels, block.hidden, ROWS, units);
    const Matrix rest{layers.first.row(channels), units};
    multiply(block.encoded.numbers, 1, ROWS, rest, layers.inputs - channels, block.hidden, ROWS, units);
    relu(block.hidden, units);
    for (int64_t i = 0; i < ROWS; i++)
        for (int64_t c = 0; c < units; c += WIDTH) store(block.second.row(i) + c, load(layers.bias_buffer.data() + c));
    multiply(block.hidden.numbers, units, 1, layers.second, layers.net.width, block.second, ROWS, units);
    relu(block.second, units);
}

typedef float Quad __attribute__((vector_size(16)));

inline Quad load_quad(const float* from) {
    Quad x;
    __builtin_memcpy(&x, from, sizeof x);
    return x;
}

// Colours of a block. The last layer has three outputs, so its lanes are few.
inline void run(const Layers& layers, Block& block) {
    run_hidden(layers, block);
    constexpr int STEP = 8;
    for (int first = 0; first < ROWS; first += STEP) {
        Quad sums[STEP] = {};
        for (int64_t k = 0; k < layers.net.width; k++) {
            const Quad weights = load_quad(layers.third.row(k));
            for (int i = 0; i < STEP; i++) sums[i] += block.second.row(first + i)[k] * weights;
        }
        for (int i = 0; i < STEP; i++)
            for (int a = 0; a < 3; a++)
                block.colors[a][first + i] = block.x.row(first + i)[a] + layers.net.third_bias[a] + sums[i][a];
    }
    for (int a = 0; a < 3; a++)
        for (int first = 0; first < ROWS; first += WIDTH) {
            const Lanes logit = load(block.colors[a] + first), color = 1.0f / (1.0f + exp_lanes(-logit));
            store(block.colors[a] + first, logit == logit ? color : logit);
        }
}
