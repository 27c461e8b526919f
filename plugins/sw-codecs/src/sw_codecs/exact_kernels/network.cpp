// A ReLU network on rows of integers with 12 fractional bits (sw_codecs.context.integer_mlp), and what its outputs mean
// to the coder.
#include <atomic>

#include "lattice.h"
#include "network.h"

namespace SW_ARCH {

using namespace splatwizard;

namespace {

// All inputs of a block as rows.
void take_block(const NetworkArgs& a, int64_t start, int64_t n, Rows& rows) {
  const int64_t width = a.layers[0].inputs;
  if (a.short_inputs != nullptr) {
    take_inputs(a.short_inputs + start * width, width, width, n, 0, rows);
  } else {
    take_inputs(a.inputs[0] + start * a.stride[0], a.width[0], a.stride[0], n, 0, rows);
    take_inputs(a.inputs[1] + start * a.stride[1], a.width[1], a.stride[1], n, a.width[0], rows);
  }
}

template <class Sink>
void outputs_of(const NetworkArgs& a, const Parallel& parallel, const Sink& sink) {
  const Packed packed(a.layers, a.depth);
  over_blocks(
      packed, a.rows, a.leak, parallel, [&](int64_t start, int64_t n, Rows& rows) { take_block(a, start, n, rows); }, sink);
}

}  // namespace

void network(const NetworkArgs& a, int64_t* out, const Parallel& parallel) {
  const int64_t count = a.layers[a.depth - 1].outputs;
  outputs_of(a, parallel, [&](int64_t start, int64_t n, const double* outputs, int64_t stride) {
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
  outputs_of(a, parallel, [&](int64_t start, int64_t n, const double* outputs, int64_t stride) {
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
