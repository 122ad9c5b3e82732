// One head's colours from looked-up features, and their gradients. The reference is ColorNetworks.forward.
#include "network.h"

#include <algorithm>

namespace {

constexpr int64_t PART = 2048; // samples whose gradients are summed together (PART of ops/colors.py)

struct Samples {
    const float *features, *ndc; // [N, channels], [N, 3]
    const float* start;          // [R, width]: what bias and direction of a ray add to the first layer
    const int64_t* rays;         // [N]; samples of a ray follow each other
    int64_t count;
};

// Samples [first, first + size) into a block.
void take(const Samples& samples, const Network& net, int64_t first, int64_t size, Block& block) {
    for (int64_t i = 0; i < size; i++) {
        const int64_t n = first + i;
        std::copy_n(samples.features + n * net.channels, net.channels, block.x.row(i));
        std::copy_n(samples.start + samples.rays[n] * net.width, net.width, block.hidden.row(i));
        for (int a = 0; a < 3; a++) block.position[a][i] = samples.ndc[3 * n + a];
    }
}

// Gradients of a network, transposed as in Layers, and what else the way back needs.
struct Gradients {
    int64_t inputs, units, features;
    Buffer memory;
    Matrix first, second, third, bias; // [inputs, units], [units, units], [3, units], [1, units]
    Matrix back_second, back_third, back_features; // weights [out, in]: [units, units], [3, units], [units, features]
    Matrix hidden, down, slopes; // [ROWS, units], [ROWS, features], [ROWS, WIDTH]
    float third_bias[3] = {};

    explicit Gradients(const Layers& layers)
        : inputs(layers.inputs), units(layers.units), features(padded(layers.net.channels)),
          memory((inputs + units + 3 + 1 + units + 3 + ROWS) * units + (units + ROWS) * features + ROWS * WIDTH) {
        float* at = memory.data();
        const auto next = [&](int64_t rows, int64_t columns) {
            const Matrix found{at, columns};
            at += rows * columns;
            return found;
        };
        first = next(inputs, units), second = next(units, units), third = next(3, units), bias = next(1, units);
        back_second = next(units, units), back_third = next(3, units), back_features = next(units, features);
        hidden = next(ROWS, units), down = next(ROWS, features), slopes = next(ROWS, WIDTH);
        const Network& net = layers.net;
        for (int64_t j = 0; j < net.width; j++) {
            std::copy_n(net.second + j * net.width, net.width, back_second.row(j));
            std::copy_n(net.first + j * inputs, net.channels, back_features.row(j));
            for (int a = 0; a < 3; a++) back_third.row(a)[j] = net.third[a * net.width + j];
        }
    }
    Gradients(const Gradients&) = delete;
};

void clear(Matrix x, int64_t rows) { std::fill_n(x.numbers, rows * x.stride, 0.0f); }

// Lets a gradient through where the layer did.
void gate(Matrix gradient, Matrix layer, int64_t rows, int64_t columns) {
    for (int64_t i = 0; i < rows; i++)
        for (int64_t c = 0; c < columns; c += WIDTH)
            store(gradient.row(i) + c, load(layer.row(i) + c) <= 0 ? Lanes{} : load(gradient.row(i) + c));
}

// sums += the sum of rows.
void add_rows(Matrix x, int64_t rows, int64_t columns, float* sums) {
    for (int64_t i = 0; i < rows; i++)
        for (int64_t c = 0; c < columns; c += WIDTH) store(sums + c, load(sums + c) + load(x.row(i) + c));
}

// From `slopes`, the gradient of a block's logits, back through layers that `run_hidden` has filled. Leaves the gradient
// of `start` in the block's `second` and that of the features in `down`.
void go_back(const Layers& layers, Block& block, int64_t size, Gradients& g) {
    const int64_t units = layers.units, width = layers.net.width;
    multiply(g.slopes.numbers, 1, WIDTH, block.second, size, g.third, 3, units);
    clear(g.hidden, ROWS);
    multiply(g.slopes.numbers, WIDTH, 1, g.back_third, 3, g.hidden, size, units);
    gate(g.hidden, block.second, size, units);
    multiply(block.hidden.numbers, 1, units, g.hidden, size, g.second, width, units);
    add_rows(g.hidden, size, units, g.bias.numbers);
    clear(block.second, ROWS); // what it held is no longer needed
    multiply(g.hidden.numbers, units, 1, g.back_second, width, block.second, size, units);
    gate(block.second, block.hidden, size, units);
    const int64_t channels = layers.net.channels;
    multiply(block.x.numbers, 1, block.x.stride, block.second, size, g.first, channels, units);
    const Matrix rest{g.first.row(channels), units};
    multiply(block.encoded.numbers, ROWS, 1, block.second, size, rest, layers.inputs - channels, units);
    clear(g.down, ROWS);
    multiply(block.second.numbers, units, 1, g.back_features, width, g.down, size, g.features);
    for (int64_t i = 0; i < size; i++)
        for (int a = 0; a < 3; a++) g.down.row(i)[a] += g.slopes.row(i)[a], g.third_bias[a] += g.slopes.row(i)[a];
}

// The gradients in the order and the shapes of Network.
void write(const Layers& layers, const Gradients& g, float* to) {
    const int64_t width = layers.net.width;
    for (int64_t j = 0; j < width; j++)
        for (int64_t i = 0; i < layers.inputs; i++) *to++ = g.first.row(i)[j];
    for (int64_t j = 0; j < width; j++)
        for (int64_t i = 0; i < width; i++) *to++ = g.second.row(i)[j];
    to = std::copy_n(g.bias.numbers, width, to);
    for (int a = 0; a < 3; a++) to = std::copy_n(g.third.row(a), width, to);
    std::copy_n(g.third_bias, 3, to);
}

// Parts begin with a ray, so that no two of them add to the same one.
int64_t part_start(const Samples& samples, int64_t part) {
    int64_t n = std::min(part * PART, samples.count);
    while (n > 0 && n < samples.count && samples.rays[n] == samples.rays[n - 1]) n++;
    return n;
}

} // namespace

extern "C" {

// Colours [N, 3] of samples [begin, end).
void mmpi_colors(const Network* net, const Samples* samples, int64_t begin, int64_t end, float* colors) {
    const Layers layers(*net);
    Block block(layers);
    for (int64_t first = begin; first < end; first += ROWS) {
        const int64_t size = std::min<int64_t>(ROWS, end - first);
        take(*samples, *net, first, size, block);
        run(layers, block);
        for (int64_t i = 0; i < size; i++)
            for (int a = 0; a < 3; a++) colors[3 * (first + i) + a] = block.colors[a][i];
    }
}

// Gradients of parts [begin, end) of PART samples each, which begin with a ray: of the features [N, channels], of `start`
// [R, width] (added to what is there) and of the weights [parts, numbers of a Network].
void mmpi_colors_back(const Network* net, const Samples* samples, const float* colors, const float* grad, int64_t begin,
                      int64_t end, float* grad_features, float* grad_start, float* grad_weights) {
    const Layers layers(*net);
    const int64_t width = net->width, channels = net->channels;
    const int64_t numbers = width * layers.inputs + width * width + width + 3 * width + 3;
    Block block(layers);
    for (int64_t part = begin; part < end; part++) {
        Gradients g(layers);
        const int64_t stop = part_start(*samples, part + 1);
        for (int64_t first = part_start(*samples, part); first < stop; first += ROWS) {
            const int64_t size = std::min<int64_t>(ROWS, stop - first);
            take(*samples, *net, first, size, block);
            run_hidden(layers, block);
            for (int64_t i = 0; i < size; i++)
                for (int a = 0; a < 3; a++) {
                    const float color = colors[3 * (first + i) + a];
                    g.slopes.row(i)[a] = grad[3 * (first + i) + a] * color * (1 - color);
                }
            go_back(layers, block, size, g);
            for (int64_t i = 0; i < size; i++) {
                std::copy_n(g.down.row(i), channels, grad_features + (first + i) * channels);
                float* to = grad_start + samples->rays[first + i] * width;
                for (int64_t j = 0; j < width; j++) to[j] += block.second.row(i)[j];
            }
        }
        write(layers, g, grad_weights + part * numbers);
    }
}
}
