// Networks of two hidden layers with ReLU, inputs -> three numbers, for many rows, with their gradients.
#include "lanes.h"
#include "parts.h"

#include <vector>

namespace {

constexpr int64_t OUTPUTS = 3;
constexpr int64_t BLOCK = 48; // rows whose layers stay in the cache
constexpr int TALL = 6, WIDE = NATIVE == WIDTH ? 4 : 1; // of a tile, whose sums fill the registers

// A matrix whose rows are `stride` numbers apart; columns are padded to whole vectors.
struct Matrix {
    int64_t rows, columns, stride;
    std::vector<float> numbers;

    Matrix(int64_t rows, int64_t columns)
        : rows(rows), columns(columns), stride((columns + WIDTH - 1) / WIDTH * WIDTH), numbers(rows * stride) {}

    float* row(int64_t i) { return numbers.data() + i * stride; }
    const float* row(int64_t i) const { return numbers.data() + i * stride; }
};

// Rows or columns of a matrix, to be multiplied.
struct Factor {
    const float* numbers;
    int64_t stride, step; // from row to row, and from number to number

    static Factor rows(const Matrix& m) { return {m.row(0), m.stride, 1}; }
    static Factor columns(const Matrix& m) { return {m.row(0), 1, m.stride}; }
};

// What a product is added to: as many rows, or the same one for all.
struct Start {
    const float* numbers;
    int64_t stride;

    static Start rows(const Matrix& m) { return {m.row(0), m.stride}; }
    static Start one(const Matrix& m) { return {m.row(0), 0}; }
};

// C = start + A B for `R` rows and `C` vectors of C, from (row, column) on; sums over K.
template <int R, int C>
void fill_tile(Start start, Factor a, const Matrix& b, int64_t K, Matrix& c, int64_t row, int64_t column) {
    Lanes sums[R][C];
    for (int r = 0; r < R; r++)
        for (int v = 0; v < C; v++) sums[r][v] = load(start.numbers + (row + r) * start.stride + column + v * WIDTH);
    const float* left = a.numbers + row * a.stride;
    const float* right = b.row(0) + column;
    for (int64_t k = 0; k < K; k++, left += a.step, right += b.stride) {
        Lanes values[C];
        for (int v = 0; v < C; v++) values[v] = load(right + v * WIDTH);
        for (int r = 0; r < R; r++)
            for (int v = 0; v < C; v++) sums[r][v] += left[r * a.stride] * values[v];
    }
    for (int r = 0; r < R; r++)
        for (int v = 0; v < C; v++) store(c.row(row + r) + column + v * WIDTH, sums[r][v]);
}

template <int R> void fill_rows(Start start, Factor a, const Matrix& b, int64_t K, Matrix& c, int64_t row) {
    int64_t column = 0;
    for (; column + WIDE * WIDTH <= c.stride; column += WIDE * WIDTH) fill_tile<R, WIDE>(start, a, b, K, c, row, column);
    for (; column < c.stride; column += WIDTH) fill_tile<R, 1>(start, a, b, K, c, row, column);
}

// C[:M] = start + A B, sums over K.
void fill(Start start, Factor a, const Matrix& b, int64_t K, Matrix& c, int64_t M) {
    int64_t row = 0;
    for (; row + TALL <= M; row += TALL) fill_rows<TALL>(start, a, b, K, c, row);
    for (; row < M; row++) fill_rows<1>(start, a, b, K, c, row);
}

// A layer's weights, as they are and transposed, and biases.
struct Layer {
    Matrix weights, transposed, biases;
    const Matrix zeros;

    // Reads them from `from`, which goes on behind them.
    Layer(const float*& from, int64_t outputs, int64_t inputs)
        : weights(outputs, inputs), transposed(inputs, outputs), biases(1, outputs), zeros(1, inputs) {
        for (int64_t o = 0; o < outputs; o++)
            for (int64_t i = 0; i < inputs; i++) weights.row(o)[i] = transposed.row(i)[o] = *from++;
        std::copy_n(from, outputs, biases.row(0)), from += outputs;
    }

    void apply(Factor inputs, int64_t count, Matrix& to) const {
        fill(Start::one(biases), inputs, transposed, weights.columns, to, count);
    }

    // Gradient of the inputs.
    void back(const Matrix& gradient, int64_t count, Matrix& to) const {
        fill(Start::one(zeros), Factor::rows(gradient), weights, weights.rows, to, count);
    }
};

// Gradients of a layer's weights and biases.
struct Slopes {
    Matrix weights, biases;

    explicit Slopes(const Layer& of) : weights(of.weights.rows, of.weights.columns), biases(1, of.weights.rows) {}

    void add(const Matrix& inputs, const Matrix& gradient, int64_t count) {
        fill(Start::rows(weights), Factor::columns(gradient), inputs, count, weights, weights.rows);
        for (int64_t n = 0; n < count; n++)
            for (int64_t o = 0; o < biases.columns; o++) biases.row(0)[o] += gradient.row(n)[o];
    }

    void write(float*& to) const {
        for (int64_t o = 0; o < weights.rows; o++) to = std::copy_n(weights.row(o), weights.columns, to);
        to = std::copy_n(biases.row(0), biases.columns, to);
    }
};

void rectify(Matrix& hidden, int64_t count) { // NaN stays NaN
    for (float* x = hidden.row(0); x < hidden.row(count); x += WIDTH)
        store(x, pick(load(x) < 0.0f, Lanes{}, load(x)));
}

// Zero where the rectified numbers are.
void mask(Matrix& gradient, const Matrix& hidden, int64_t count) {
    for (int64_t i = 0; i < count * hidden.stride; i += WIDTH)
        store(gradient.row(0) + i, pick(load(hidden.row(0) + i) > 0.0f, load(gradient.row(0) + i), Lanes{}));
}

struct Network {
    const Layer first, second, last;
    Matrix one, two, outputs; // of a block of rows

    Network(const float* weights, int64_t width, int64_t channels)
        : first(weights, width, channels), second(weights, width, width), last(weights, OUTPUTS, width),
          one(BLOCK, width), two(BLOCK, width), outputs(BLOCK, OUTPUTS) {}

    void run(const float* inputs, int64_t count) {
        first.apply({inputs, first.weights.columns, 1}, count, one), rectify(one, count);
        second.apply(Factor::rows(one), count, two), rectify(two, count);
        last.apply(Factor::rows(two), count, outputs);
    }
};

void mmpi_network(int64_t begin, int64_t end, const float* weights, const float* inputs, int64_t width, int64_t channels,
                  float* outputs) {
    Network network(weights, width, channels);
    for (int64_t row = begin; row < end; row += BLOCK) {
        const int64_t count = std::min(BLOCK, end - row);
        network.run(inputs + row * channels, count);
        for (int64_t n = 0; n < count; n++) std::copy_n(network.outputs.row(n), OUTPUTS, outputs + (row + n) * OUTPUTS);
    }
}

// Gradients of the inputs, and of the weights, summed over each of the chunks [begin, end) of `size` rows.
void mmpi_network_back(int64_t begin, int64_t end, const float* weights, const float* inputs, const float* grad_outputs,
                       int64_t rows, int64_t size, int64_t width, int64_t channels, float* grad_inputs,
                       float* grad_weights) {
    Network network(weights, width, channels);
    const Layer &first = network.first, &second = network.second, &last = network.last;
    Matrix given(BLOCK, channels), at_outputs(BLOCK, OUTPUTS), at_two(BLOCK, width), at_one(BLOCK, width),
        at_inputs(BLOCK, channels);
    const int64_t parameters = width * (channels + 1 + width + 1 + OUTPUTS) + OUTPUTS;
    for (int64_t chunk = begin; chunk < end; chunk++) {
        Slopes of_first(first), of_second(second), of_last(last);
        const int64_t until = std::min(rows, (chunk + 1) * size);
        for (int64_t row = chunk * size; row < until; row += BLOCK) {
            const int64_t count = std::min(BLOCK, until - row);
            network.run(inputs + row * channels, count);
            for (int64_t n = 0; n < count; n++) {
                std::copy_n(inputs + (row + n) * channels, channels, given.row(n));
                std::copy_n(grad_outputs + (row + n) * OUTPUTS, OUTPUTS, at_outputs.row(n));
            }
            of_last.add(network.two, at_outputs, count), last.back(at_outputs, count, at_two);
            mask(at_two, network.two, count);
            of_second.add(network.one, at_two, count), second.back(at_two, count, at_one);
            mask(at_one, network.one, count);
            of_first.add(given, at_one, count), first.back(at_one, count, at_inputs);
            for (int64_t n = 0; n < count; n++)
                std::copy_n(at_inputs.row(n), channels, grad_inputs + (row + n) * channels);
        }
        float* to = grad_weights + chunk * parameters;
        of_first.write(to), of_second.write(to), of_last.write(to);
    }
}

} // namespace

IN_PARTS(mmpi_network)
IN_PARTS(mmpi_network_back)
