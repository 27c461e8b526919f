// A ReLU network on rows of integers with 12 fractional bits (sw_codecs.context.integer_mlp), in float64.
#include "kernels.h"
#include "rans.h"
#include "vectors.h"

namespace SW_ARCH {

using namespace splatwizard;

namespace {

// Sums of ROWS rows and WIDE vectors of outputs are kept in registers.
#ifdef __AVX512F__
constexpr int ROWS = 8;
#else
constexpr int ROWS = 4;
#endif
constexpr int WIDE = 3, TILE = WIDE * LANES, BLOCK = 12 * ROWS;

constexpr int64_t DEEP = 128;  // inputs at once: their weights of a tile stay in the first cache

// Adds to sums of ROWS rows, [ROWS, TILE]; `in` has `stride` numbers a row.
inline void add_products(const double* in, int64_t stride, const double* weights, int64_t inputs, double* sums) {
  Vec sum[ROWS][WIDE];
#pragma GCC unroll 8
  for (int r = 0; r < ROWS; ++r)
#pragma GCC unroll 8
    for (int v = 0; v < WIDE; ++v) sum[r][v] = load(sums + r * TILE + v * LANES);
  for (int64_t k = 0; k < inputs; ++k) {
    Vec w[WIDE];
#pragma GCC unroll 8
    for (int v = 0; v < WIDE; ++v) w[v] = load(weights + k * TILE + v * LANES);
#pragma GCC unroll 8
    for (int r = 0; r < ROWS; ++r) {
      const Vec a = all(in[r * stride + k]);
#pragma GCC unroll 8
      for (int v = 0; v < WIDE; ++v) sum[r][v] += w[v] * a;
    }
  }
#pragma GCC unroll 8
  for (int r = 0; r < ROWS; ++r)
#pragma GCC unroll 8
    for (int v = 0; v < WIDE; ++v) store(sums + r * TILE + v * LANES, sum[r][v]);
}

int64_t padded(int64_t outputs) { return (outputs + TILE - 1) / TILE * TILE; }

}  // namespace

int64_t tile() { return TILE; }

void network(const Layer* layers, int64_t depth, const int64_t* inputs, int64_t rows, int64_t* out,
             const Parallel& parallel) {
  int64_t widest = layers[0].inputs;
  for (int64_t i = 0; i < depth; ++i) widest = padded(layers[i].outputs) > widest ? padded(layers[i].outputs) : widest;
  const int64_t width = layers[0].inputs, outputs = layers[depth - 1].outputs;
  parallel((rows + BLOCK - 1) / BLOCK, 4, [&](int64_t begin, int64_t end) {
    Scratch<double> first(BLOCK * widest), second(BLOCK * widest), sums(BLOCK * TILE);
    for (int64_t block = begin; block < end; ++block) {
      const int64_t start = block * BLOCK, n = rows - start < BLOCK ? rows - start : BLOCK;
      double *a = first.data, *b = second.data;
      for (int64_t i = 0; i < n * width; ++i) {
        const int64_t limit = int64_t{1} << 20, x = inputs[start * width + i];
        a[i] = static_cast<double>(static_cast<int32_t>(x < -limit ? -limit : x > limit ? limit : x));
      }
      for (int64_t i = n * width; i < BLOCK * width; ++i) a[i] = 0;
      for (int64_t layer = 0; layer < depth; ++layer) {
        const Layer& l = layers[layer];
        const int64_t stride = layer == 0 ? width : padded(layers[layer - 1].outputs), to = padded(l.outputs);
        for (int64_t t = 0; t * TILE < l.outputs; ++t) {
          for (int64_t r = 0; r < BLOCK; ++r)
            std::memcpy(sums.data + r * TILE, l.bias + t * TILE, sizeof(double) * TILE);
          for (int64_t k = 0; k < l.inputs; k += DEEP) {
            const double* weights = l.weights + (t * l.inputs + k) * TILE;
            const int64_t deep = l.inputs - k < DEEP ? l.inputs - k : DEEP;
            for (int64_t r = 0; r < n; r += ROWS)
              add_products(a + r * stride + k, stride, weights, deep, sums.data + r * TILE);
          }
          const int64_t count = l.outputs - t * TILE < TILE ? l.outputs - t * TILE : TILE;
          for (int64_t r = 0; r < n; ++r) {
            int64_t whole[TILE];
            for (int v = 0; v < WIDE; ++v) {
              const Vec x = shifted(load(sums.data + r * TILE + v * LANES));
              if (layer < depth - 1)
                store(b + r * to + t * TILE + v * LANES, clamped(x, 0, ACTIVATION_LIMIT));
              else
                store_integers(whole + v * LANES, x);
            }
            if (layer == depth - 1)
              std::memcpy(out + (start + r) * outputs + t * TILE, whole, sizeof(int64_t) * static_cast<size_t>(count));
          }
        }
        double* swap = a;
        a = b;
        b = swap;
      }
    }
  });
}

}  // namespace SW_ARCH
