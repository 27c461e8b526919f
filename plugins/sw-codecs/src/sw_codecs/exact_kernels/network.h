// Blocks of rows on their way through all layers of a ReLU network on integers with 12 fractional bits.
#pragma once
#include "layers.h"

namespace SW_ARCH {

using splatwizard::Parallel;

// Numbers of n rows from column `column` of the rows on, within +-2^20.
template <class T>
void take_inputs(const T* inputs, int64_t width, int64_t stride, int64_t n, int64_t column, Rows& rows) {
  constexpr int64_t LIMIT = int64_t{1} << 20;
  int32_t most = 0;
  for (int64_t r = 0; r < n; ++r) {
    int32_t* to = rows.value.data + r * rows.stride + column;
    for (int64_t i = 0; i < width; ++i) {
      const int64_t x = inputs[r * stride + i];
      to[i] = static_cast<int32_t>(x < -LIMIT ? -LIMIT : x > LIMIT ? LIMIT : x);
    }
    for (int64_t i = 0; i < width; ++i) {
      const int32_t size = to[i] < 0 ? -to[i] : to[i];
      most = size > most ? size : most;
    }
  }
  rows.most = most > rows.most ? most : rows.most;
}

// The outputs of a layer between others as rows.
inline void take_outputs(const Tiles& l, int64_t t, const double* sums, int64_t leak, Rows& rows) {
  const Vec slope = all(static_cast<double>(leak) / 4096);  // times an integer below 2^41: exact
  const int64_t outputs = l.outputs - t * TILE < TILE ? l.outputs - t * TILE : TILE;
  Narrow most{};
  for (int64_t r = 0; r < BLOCK; ++r)
    for (int v = 0; v < outputs; v += LANES) {
      Vec x = shifted(load(sums + r * TILE + v));
      if (leak) x = x < all(0) ? floor_of(x * slope) : x;
      const Narrow whole = __builtin_convertvector(clamped(x, leak ? -ACTIVATION_LIMIT : 0, ACTIVATION_LIMIT), Narrow);
      const Narrow size = leak ? (whole < 0 ? -whole : whole) : whole;
      most = size > most ? size : most;
      store_narrow(rows.value.data + r * l.padded() + t * TILE + v, whole);
    }
  for (int i = 0; i < LANES; ++i) rows.most = most[i] > rows.most ? most[i] : rows.most;
}

// All layers in tiles.
struct Packed {
  Scratch<Tiles*> layer;
  int64_t depth, widest;

  Packed(const splatwizard::Layer* layers, int64_t count) : layer(count), depth(0), widest(layers[0].inputs + 1) {
    for (; depth < count; ++depth) {
      layer[depth] = new Tiles(layers[depth]);
      widest = layer[depth]->padded() > widest ? layer[depth]->padded() : widest;
    }
  }
  ~Packed() {
    for (int64_t i = 0; i < depth; ++i) delete layer[i];
  }
};

// Calls source(first row, rows, numbers of the first layer) and sink(first row, rows, outputs [rows, stride], stride) for
// every block; numbers are within +-2^20 and their `most` is set, outputs are integers, and a vector may be read behind
// the last one.
template <class Source, class Sink>
void over_blocks(const Packed& packed, int64_t rows, int64_t leak, const Parallel& parallel, const Source& source,
                 const Sink& sink) {
  const int64_t width = packed.layer[0]->inputs, stride = packed.layer[packed.depth - 1]->padded();
  parallel((rows + BLOCK - 1) / BLOCK, 4, [&](int64_t begin, int64_t end) {
    Rows even(packed.widest), odd(packed.widest);
    Scratch<double> sums(BLOCK * TILE), outputs(BLOCK * stride + LANES);
    for (int64_t i = 0; i < LANES; ++i) outputs[BLOCK * stride + i] = 0;
    for (int64_t block = begin; block < end; ++block) {
      const int64_t start = block * BLOCK, n = rows - start < BLOCK ? rows - start : BLOCK;
      even.begin(width + width % 2);
      source(start, n, even);
      for (int64_t r = 0; r < n && width % 2; ++r) even.value[r * even.stride + width] = 0;
      std::memset(even.value.data + n * even.stride, 0, sizeof(int32_t) * static_cast<size_t>((BLOCK - n) * even.stride));
      for (int64_t layer = 0; layer < packed.depth; ++layer) {
        const Tiles& l = *packed.layer[layer];
        Rows &from = layer % 2 ? odd : even, &to = layer % 2 ? even : odd;
        if (layer < packed.depth - 1) to.begin(l.padded());
        for (int64_t t = 0; t < l.tiles; ++t) {
          tile_sums(l, t, from, n, sums.data);
          if (layer < packed.depth - 1)
            take_outputs(l, t, sums.data, leak, to);
          else
            for (int64_t r = 0; r < BLOCK; ++r)
              for (int64_t v = 0; v < TILE && t * TILE + v < l.outputs; v += LANES)
                store(outputs.data + r * stride + t * TILE + v, shifted(load(sums.data + r * TILE + v)));
        }
      }
      sink(start, n, outputs.data, stride);
    }
  });
}

}  // namespace SW_ARCH
