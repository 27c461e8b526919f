// A training step of wisp on a GPU (../rows.h): a thread takes a row, a block of a row, or a number.
#include "rows.h"

namespace sw_wisp::cuda {
namespace {

constexpr int kThreads = 128, kWarp = 32;

struct FloatMath {
  using Real = float;
  SW_WISP_HD static float number(float x) { return x; }
  SW_WISP_HD static float exponential(float x) { return expf(x); }
  SW_WISP_HD static float complement(float x) { return erfcf(x); }
  SW_WISP_HD static float bent(float x) { return tanhf(x); }
  SW_WISP_HD static float root(float x) { return sqrtf(x); }
  SW_WISP_HD static float floor(float x) { return floorf(x); }
  SW_WISP_HD static float nearest(float x) { return rintf(x); }
  SW_WISP_HD static float look_up(const float* table, float index) { return table[int(index)]; }
  SW_WISP_HD static float load(const float* from, int64_t) { return *from; }
  SW_WISP_HD static void store(float* to, int64_t, float value) { *to = value; }
};

__device__ __forceinline__ int64_t place() { return int64_t(blockIdx.x) * kThreads + threadIdx.x; }

unsigned blocks_of(int64_t threads) { return unsigned((threads + kThreads - 1) / kThreads); }

__device__ __forceinline__ double sum_of_warp(double value) {
#pragma unroll
  for (int lanes = kWarp / 2; lanes > 0; lanes /= 2) value += __shfl_xor_sync(0xffffffffu, value, lanes);
  return value;
}

// A warp takes a row; all of its lanes find the same sums, and so the same exponent.
__global__ void __launch_bounds__(kThreads) eight_bits_kernel(const __grid_constant__ Matrices of) {
  int64_t row = place() / kWarp;
  const int lane = int(threadIdx.x) % kWarp;
  int index = 0;
  while (index < of.count && row >= of.each[index].rows) row -= of.each[index++].rows;
  if (index == of.count) return;
  const Matrix& matrix = of.each[index];
  const float* const weights = matrix.weights + row * matrix.columns;
  double least = HUGE_VAL, best = 1.;
  for (int exponent = of.lowest; exponent <= kHighestExponent; ++exponent) {
    const double unit = ldexp(1., exponent), per_unit = ldexp(1., -exponent);
    double error = 0.;
    for (int64_t j = lane; j < matrix.columns; j += kWarp) {
      const double off = in_eight_bits(weights[j], unit, per_unit) - double(weights[j]);
      error += off * off;
    }
    error = sum_of_warp(error);
    if (error < least) least = error, best = unit;
  }
  for (int64_t j = lane; j < matrix.columns; j += kWarp)
    matrix.rounded[row * matrix.columns + j] = float(in_eight_bits(weights[j], best, 1. / best));
}

template <int kNumber>
__global__ void __launch_bounds__(kThreads) draw_kernel(const __grid_constant__ Draw of) {
  constexpr Block block = block_of(kNumber);
  if (place() < of.rows) draw_block<FloatMath>(block, of, place());
}

__global__ void __launch_bounds__(kThreads) draw_backward_kernel(const __grid_constant__ DrawBack of) {
  if (place() < of.rows) draw_back<FloatMath>(block_of(int(blockIdx.y)), of, place());
}

__global__ void __launch_bounds__(kThreads) bits_kernel(const __grid_constant__ CountedRows of) {
  const int64_t i = place(), at = i + (of.rows - of.last) * kNumbers;
  if (i >= of.last * kNumbers) return;
  of.bits[i] = -log2f(bits_of<FloatMath>(of.values[at] - of.mean[at], of.scale[at], of.steps[at], 1.f).probability);
}

__global__ void __launch_bounds__(kThreads) bits_backward_kernel(const __grid_constant__ CountedRows of) {
  const int64_t at = place(), i = at - (of.rows - of.last) * kNumbers;
  if (at >= of.rows * kNumbers) return;
  Bits<FloatMath> found{0.f, 0.f, 0.f, 0.f};
  if (i >= 0) found = bits_of<FloatMath>(of.values[at] - of.mean[at], of.scale[at], of.steps[at], of.by_bits[i]);
  of.to_values[at] = found.by_value, of.to_mean[at] = -found.by_value;
  of.to_scale[at] = found.by_scale, of.to_steps[at] = found.by_step;
}

__global__ void __launch_bounds__(kThreads) splats_kernel(const __grid_constant__ Splats of) {
  const int64_t row = place();
  if (row >= of.rows) return;
  const float* const values = of.values + row * kNumbers;
  float numbers[6];
#pragma unroll
  for (int i = 0; i < 6; ++i) numbers[i] = values[1 + i];
  const Axes<FloatMath> axes = axes_of<FloatMath>(numbers, numbers[5] + of.log_edges[row]);
  covariance_of<FloatMath>(axes, of.low, of.high, of.covariances + row * 6);
  float* const to = of.axes + row * 12;
#pragma unroll
  for (int i = 0; i < 3; ++i) {
    to[i] = axes.values[i];
#pragma unroll
    for (int j = 0; j < 3; ++j) to[3 + 3 * i + j] = axes.vectors[i][j];
  }
  of.opacities[row] = 1.f / (1.f + expf(-values[0]));
  band_zero_of(values + kColour, of.dc + row * 3);
}

__global__ void __launch_bounds__(kThreads) splats_backward_kernel(const __grid_constant__ SplatsBack of) {
  const int64_t row = place();
  if (row >= of.rows) return;
  float to[kNumbers] = {};
  if (of.by_covariances != nullptr) {
    const float* const given = of.axes + row * 12;
    Axes<FloatMath> axes;
    float by[6];
#pragma unroll
    for (int i = 0; i < 3; ++i) {
      axes.values[i] = given[i];
#pragma unroll
      for (int j = 0; j < 3; ++j) axes.vectors[i][j] = given[3 + 3 * i + j];
    }
#pragma unroll
    for (int i = 0; i < 6; ++i) by[i] = of.by_covariances[row * 6 + i];
    covariance_back<FloatMath>(axes, by, of.low, of.high, to + 1, to[6]);
  }
  const float opacity = of.opacities[row];
  if (of.by_opacities != nullptr) to[0] = of.by_opacities[row] * (1.f - opacity) * opacity;
  if (of.by_dc != nullptr) band_zero_back(of.by_dc + row * 3, to + kColour);
#pragma unroll
  for (int i = 0; i < kDrawn; ++i) to[kColour + i] += of.by_colour == nullptr ? 0.f : of.by_colour[row * kDrawn + i];
#pragma unroll
  for (int i = 0; i < kNumbers; ++i) of.to_values[row * kNumbers + i] = to[i];
}

}  // namespace

void eight_bits(const Matrices& of, cudaStream_t stream) {
  int64_t rows = 0;
  for (int i = 0; i < of.count; ++i) rows += of.each[i].rows;
  if (rows > 0) eight_bits_kernel<<<blocks_of(rows * kWarp), kThreads, 0, stream>>>(of);
}

void draw(const Draw& of, cudaStream_t stream) {
  const unsigned blocks = blocks_of(of.rows);
  if (blocks == 0) return;
  switch (of.block) {
    case 0: draw_kernel<0><<<blocks, kThreads, 0, stream>>>(of); break;
    case 1: draw_kernel<1><<<blocks, kThreads, 0, stream>>>(of); break;
    case 2: draw_kernel<2><<<blocks, kThreads, 0, stream>>>(of); break;
    default: draw_kernel<3><<<blocks, kThreads, 0, stream>>>(of);
  }
}

void draw_backward(const DrawBack& of, cudaStream_t stream) {
  if (of.rows > 0) draw_backward_kernel<<<dim3(blocks_of(of.rows), kBlocks), kThreads, 0, stream>>>(of);
}

void bits(const CountedRows& of, cudaStream_t stream) {
  if (of.last > 0) bits_kernel<<<blocks_of(of.last * kNumbers), kThreads, 0, stream>>>(of);
}

void bits_backward(const CountedRows& of, cudaStream_t stream) {
  if (of.rows > 0) bits_backward_kernel<<<blocks_of(of.rows * kNumbers), kThreads, 0, stream>>>(of);
}

void splats(const Splats& of, cudaStream_t stream) {
  if (of.rows > 0) splats_kernel<<<blocks_of(of.rows), kThreads, 0, stream>>>(of);
}

void splats_backward(const SplatsBack& of, cudaStream_t stream) {
  if (of.rows > 0) splats_backward_kernel<<<blocks_of(of.rows), kThreads, 0, stream>>>(of);
}

}  // namespace sw_wisp::cuda
