// Bits of a sample of anchors under predicted distributions (../mixture.h): and inputs of the networks of channels, and
// the way back: a warp takes a row.
#include "mixture.h"

namespace sw_hac::cuda {
namespace {

constexpr int kWarp = 32, kRows = 8, kGroups = 3;
constexpr unsigned kAll = 0xffffffffu;

struct FloatMath {
  using Real = float;
  SW_MIXTURE_HD static float number(float x) { return x; }
  SW_MIXTURE_HD static float exponential(float x) { return expf(x); }
  SW_MIXTURE_HD static float complement(float x) { return erfcf(x); }
};

__device__ __forceinline__ float sum_of_warp(float value) {
#pragma unroll
  for (int lanes = kWarp / 2; lanes > 0; lanes /= 2) value += __shfl_xor_sync(kAll, value, lanes);
  return value;
}

// Rows are those of a warp, so that all of its lanes return together.
__global__ void __launch_bounds__(kWarp* kRows)
    bits_kernel(const __grid_constant__ Mixture from, const __grid_constant__ MixtureSlopes to) {
  const int64_t row = int64_t(blockIdx.x) * kRows + threadIdx.y;
  if (row >= from.count) return;
  const int lane = int(threadIdx.x), f = from.features, k = from.offsets, numbers = f + 6 + 3 * k;
  const int logits = from.width - f, meaningless = from.second == nullptr ? from.width : logits;
  const float* const outputs = from.outputs + row * from.width;
  const float* const second = from.second + row * 3 * f;  // not read if there is none
  const float* const masks = from.masks + row * k;
  float* const to_outputs = to.outputs + row * from.width;
  float* const to_second = to.second + row * 3 * f;
  float* const to_masks = to.masks + row * k;
  bool there = false;
  for (int j = 0; j < k; ++j) there = there || masks[j] > 0.f;
  const float counted = from.counted[row], present = from.kind == kAlone || there ? counted : 0.f;
  float bits[kGroups] = {}, steps[kGroups] = {};
  // An item is a number, or an offset with its three coordinates, which share a mask.
  for (int item = lane; item < f + 6 + k; item += kWarp) {
    const int group = item < f ? 0 : item < f + 6 ? 1 : 2, offset = item - f - 6;
    const int first = group < 2 ? item : f + 6 + 3 * offset, last = group < 2 ? first + 1 : first + 3;
    const float mask = group < 2 ? 1.f : masks[offset];
    const float factor = group == 2 && from.kind == kAlone ? mask : present * mask;
    const float step = from.steps[row * kGroups + group];
    float own = 0.f, by_step = 0.f;
    for (int column = first; column < last; ++column) {
      const MixturePlace place = mixture_place(column, f, k);
      const int mean = place.mean, scale = place.mean + place.apart;
      const float mean_unit = from.units[mean], scale_unit = from.units[scale], x = from.x[row * numbers + column];
      const Normal<FloatMath> grid{outputs[mean] * mean_unit, outputs[scale] * scale_unit};
      float probability, by_x;
      Normal<FloatMath> by_grid;
      if (group == 0 && from.second != nullptr) {
        const int at_mean = from.columns[column], at_scale = from.columns[f + column];
        const int at_logit = from.columns[2 * f + column];
        const float unit = from.units[logits + column];
        const Normal<FloatMath> channel{from.base * second[at_mean], from.base * second[at_scale]};
        const float logit = outputs[logits + column] * unit - second[at_logit];
        const TwoBits<FloatMath> found = two_bits<FloatMath>(x, step, factor, grid, channel, logit, from.bounds);
        probability = found.probability, by_x = found.by_x, by_step += found.by_step, by_grid = found.by_first;
        to_second[at_mean] = from.base * found.by_second.mean;
        to_second[at_scale] = from.base * found.by_second.scale;
        to_second[at_logit] = -found.by_logit;
        to_outputs[logits + column] = found.by_logit * unit;
      } else {
        const OneBits<FloatMath> found = one_bits<FloatMath>(x, step, factor, grid, from.bounds);
        probability = found.probability, by_x = found.by_x, by_step += found.by_step, by_grid = found.by_first;
      }
      own -= log2f(probability);
      to.x[row * numbers + column] = by_x;
      to_outputs[mean] = by_grid.mean * mean_unit, to_outputs[scale] = by_grid.scale * scale_unit;
    }
    if (group == 2) to_masks[offset] = own;
#pragma unroll
    for (int g = 0; g < kGroups; ++g) bits[g] += g == group ? mask * own : 0.f, steps[g] += g == group ? by_step : 0.f;
  }
  for (int column = 2 * numbers + lane; column < meaningless; column += kWarp) to_outputs[column] = 0.f;
#pragma unroll
  for (int group = 0; group < kGroups; ++group)
    bits[group] = sum_of_warp(bits[group]), steps[group] = sum_of_warp(steps[group]);
  const float whole = bits[0] + bits[1] + bits[2];
#pragma unroll
  for (int group = 0; group < kGroups; ++group)
    if (lane == group) {
      to.bits[row * kGroups + group] = (group == 2 && from.kind == kAlone ? 1.f : present) * bits[group];
      to.steps[row * kGroups + group] = steps[group];
    }
  if (from.kind == kAlone) return;
  // Items go by the same lanes as before: each reads what it wrote.
  for (int item = lane; item < f + 6 + k; item += kWarp) {
    const int offset = item - f - 6;
    if (offset < 0) continue;
    to_masks[offset] = present * to_masks[offset] + (from.kind == kGatedMean ? counted * whole / float(k) : 0.f);
  }
}

__global__ void __launch_bounds__(kWarp* kRows)
    inputs_kernel(const __grid_constant__ Channels of, const float* x, const float* outputs, float* to) {
  const int64_t row = int64_t(blockIdx.x) * kRows + threadIdx.y;
  if (row >= of.count) return;
  for (int column = int(threadIdx.x); column < of.inputs; column += kWarp) {
    const ChannelSource from = channel_source(column, of.features, of.width, of.context, of.units, of.base);
    const float value = from.x >= 0        ? x[row * of.numbers + from.x]
                        : from.output >= 0 ? outputs[row * of.width + from.output]
                                           : 1.f;
    to[row * of.inputs + column] = from.factor * value;
  }
}

__device__ __forceinline__ float through_inputs(const Channels& of, const ChannelSlopes& by, int64_t row, int place) {
  if (by.inputs == nullptr || place < 0) return 0.f;
  const ChannelSource from = channel_source(place, of.features, of.width, of.context, of.units, of.base);
  return from.factor * by.inputs[row * of.inputs + place];
}

__global__ void __launch_bounds__(kWarp* kRows)
    slopes_kernel(const __grid_constant__ Channels of, const __grid_constant__ ChannelSlopes by, float* to_x,
                  float* to_outputs) {
  const int64_t row = int64_t(blockIdx.x) * kRows + threadIdx.y;
  if (row >= of.count) return;
  const float slope = *by.slope;
  for (int column = int(threadIdx.x); column < of.numbers; column += kWarp) {
    const float sum = through_inputs(of, by, row, channel_input_of_x(column, of.features));
    to_x[row * of.numbers + column] = slope * (by.x[row * of.numbers + column] + sum);
  }
  for (int column = int(threadIdx.x); column < of.width; column += kWarp) {
    const int place = channel_input_of_output(column, of.features, of.width, of.context);
    const float sum = through_inputs(of, by, row, place);
    to_outputs[row * of.width + column] = slope * (by.outputs[row * of.width + column] + sum);
  }
}

dim3 threads() { return {kWarp, kRows}; }
unsigned blocks_of(int64_t rows) { return unsigned((rows + kRows - 1) / kRows); }

}  // namespace

void mixture_bits(const Mixture& from, const MixtureSlopes& to, cudaStream_t stream) {
  if (from.count > 0) bits_kernel<<<blocks_of(from.count), threads(), 0, stream>>>(from, to);
}

void channel_inputs(const Channels& of, const float* x, const float* outputs, float* to, cudaStream_t stream) {
  if (of.count > 0) inputs_kernel<<<blocks_of(of.count), threads(), 0, stream>>>(of, x, outputs, to);
}

void channel_slopes(const Channels& of, const ChannelSlopes& by, float* to_x, float* to_outputs, cudaStream_t stream) {
  if (of.count > 0) slopes_kernel<<<blocks_of(of.count), threads(), 0, stream>>>(of, by, to_x, to_outputs);
}

}  // namespace sw_hac::cuda
