// A ReLU network on rows of integers with 12 fractional bits (sw_codecs.context.integer_mlp), and what its outputs mean
// to the coder.
#include <atomic>

#include "lattice.h"
#include "layers.h"

namespace SW_ARCH {

using namespace splatwizard;

namespace {

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

// All inputs of a block as rows.
void take_block(const NetworkArgs& a, int64_t start, int64_t n, Rows& rows) {
  const int64_t width = a.layers[0].inputs;
  rows.begin(width + width % 2);
  if (a.short_inputs != nullptr) {
    take_inputs(a.short_inputs + start * width, width, width, n, 0, rows);
  } else {
    take_inputs(a.inputs[0] + start * a.stride[0], a.width[0], a.stride[0], n, 0, rows);
    take_inputs(a.inputs[1] + start * a.stride[1], a.width[1], a.stride[1], n, a.width[0], rows);
  }
  for (int64_t r = 0; r < n && width % 2; ++r) rows.value[r * rows.stride + width] = 0;
  std::memset(rows.value.data + n * rows.stride, 0, sizeof(int32_t) * static_cast<size_t>((BLOCK - n) * rows.stride));
}

// The outputs of a layer between others as rows.
void take_outputs(const Tiles& l, int64_t t, const double* sums, int64_t leak, Rows& rows) {
  const Vec slope = all(static_cast<double>(leak) / 4096);  // times an integer below 2^41: exact
  Narrow most{};
  for (int64_t r = 0; r < BLOCK; ++r)
    for (int v = 0; v < TILE; v += LANES) {
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

  Packed(const Layer* layers, int64_t count) : layer(count), depth(0), widest(layers[0].inputs + 1) {
    for (; depth < count; ++depth) {
      layer[depth] = new Tiles(layers[depth]);
      widest = layer[depth]->padded() > widest ? layer[depth]->padded() : widest;
    }
  }
  ~Packed() {
    for (int64_t i = 0; i < depth; ++i) delete layer[i];
  }
};

// Calls sink(first row, rows, outputs [rows, stride], stride) for every block; outputs are integers, and a vector may be
// read behind the last one.
template <class Sink>
void over_blocks(const NetworkArgs& a, const Parallel& parallel, const Sink& sink) {
  const Packed packed(a.layers, a.depth);
  const int64_t stride = packed.layer[a.depth - 1]->padded();
  parallel((a.rows + BLOCK - 1) / BLOCK, 4, [&](int64_t begin, int64_t end) {
    Rows even(packed.widest), odd(packed.widest);
    Scratch<double> sums(BLOCK * TILE), outputs(BLOCK * stride + LANES);
    for (int64_t i = 0; i < LANES; ++i) outputs[BLOCK * stride + i] = 0;
    for (int64_t block = begin; block < end; ++block) {
      const int64_t start = block * BLOCK, n = a.rows - start < BLOCK ? a.rows - start : BLOCK;
      take_block(a, start, n, even);
      for (int64_t layer = 0; layer < a.depth; ++layer) {
        const Tiles& l = *packed.layer[layer];
        Rows &from = layer % 2 ? odd : even, &to = layer % 2 ? even : odd;
        if (layer < a.depth - 1) to.begin(l.padded());
        for (int64_t t = 0; t < l.tiles; ++t) {
          tile_sums(l, t, from, n, sums.data);
          if (layer < a.depth - 1)
            take_outputs(l, t, sums.data, a.leak, to);
          else
            for (int64_t r = 0; r < BLOCK; ++r)
              for (int v = 0; v < TILE; v += LANES)
                store(outputs.data + r * stride + t * TILE + v, shifted(load(sums.data + r * TILE + v)));
        }
      }
      sink(start, n, outputs.data, stride);
    }
  });
}

}  // namespace

void network(const NetworkArgs& a, int64_t* out, const Parallel& parallel) {
  const int64_t count = a.layers[a.depth - 1].outputs;
  over_blocks(a, parallel, [&](int64_t start, int64_t n, const double* outputs, int64_t stride) {
    for (int64_t r = 0; r < n; ++r) {
      int64_t* to = out + (start + r) * count;
      int64_t c = 0;
      for (; c + LANES <= count; c += LANES) store_integers(to + c, load(outputs + r * stride + c));
      for (; c < count; ++c) to[c] = static_cast<int64_t>(outputs[r * stride + c]);
    }
  });
}

int32_t forecast(const NetworkArgs& a, const ForecastArgs& to, const Parallel& parallel) {
  const Levels levels(to.thresholds);
  std::atomic<int32_t> status{FINE};
  int64_t steps = 0;
  for (int64_t g = 0; g < to.groups; ++g) steps += 2 * to.columns[g];
  over_blocks(a, parallel, [&](int64_t start, int64_t n, const double* outputs, int64_t stride) {
    int32_t centre[COLUMNS], fine = FINE;
    int16_t number[COLUMNS];
    bool beyond = false;
    for (int64_t r = 0; r < n; ++r, outputs += stride) {
      const double* mean = outputs;
      for (int64_t g = 0; g < to.groups; ++g) {
        const int64_t columns = to.columns[g], row = start + r;
        const int64_t j = (static_cast<int64_t>(outputs[steps + g]) + (1 << 15)) >> 9;
        const int64_t m = to.multipliers[j < 0 ? 0 : j > 127 ? 127 : j];
        to.steps[row * to.groups + g] = m;
        for (int64_t c = 0; c < columns; c += COLUMNS) {
          const int64_t count = columns - c < COLUMNS ? columns - c : COLUMNS;
          beyond |= columns_of(levels, mean + c, mean + columns + c, m, count, centre, number);
          std::memcpy(to.centre[g] + row * columns + c, centre, sizeof(int32_t) * static_cast<size_t>(count));
          std::memcpy(to.number[g] + row * columns + c, number, sizeof(int16_t) * static_cast<size_t>(count));
        }
        mean += 2 * columns;
      }
    }
    if (beyond) status.compare_exchange_strong(fine, BEYOND_LIMIT);
  });
  return status;
}

}  // namespace SW_ARCH
