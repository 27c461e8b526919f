// Rows of anchors in a training step: a warp takes a row, whose numbers follow one another in memory.
#include "rows.h"

namespace sw_anchors::cuda {
namespace {

constexpr int kWarp = 32, kRows = 8;  // rows of a block
constexpr unsigned kAll = 0xffffffffu;

__device__ __forceinline__ int64_t own_row() { return int64_t(blockIdx.x) * kRows + threadIdx.y; }

// kGather: row `other` is that of `from`; else that of `to`.
template <bool kGather>
__global__ void __launch_bounds__(kWarp* kRows)
    copy_kernel(const __grid_constant__ RowCopies copies, const int64_t* rows, int64_t n) {
  const int64_t row = own_row();
  if (row >= n) return;
  const int64_t other = rows[row], source = kGather ? other : row, target = kGather ? row : other;
  for (int word = int(threadIdx.x), i = 0; word < copies.words; word += kWarp) {
    while (word >= copies.last[i]) ++i;
    const int own = word - (i == 0 ? 0 : copies.last[i - 1]);
    copies.to[i][target * copies.to_row[i] + own] = copies.from[i][source * copies.from_row[i] + own];
  }
}

__global__ void __launch_bounds__(kWarp* kRows) clear_kernel(const __grid_constant__ RowCopies copies, int64_t n) {
  const int64_t row = own_row();
  if (row >= n) return;
  for (int word = int(threadIdx.x), i = 0; word < copies.words; word += kWarp) {
    while (word >= copies.last[i]) ++i;
    copies.to[i][row * copies.to_row[i] + word - (i == 0 ? 0 : copies.last[i - 1])] = 0;
  }
}

// Row i of each `from` is added to row rows[i] of `to`; rows may be named more than once.
__global__ void __launch_bounds__(kWarp* kRows)
    add_kernel(const __grid_constant__ RowCopies copies, const int64_t* rows, int64_t n) {
  const int64_t row = own_row();
  if (row >= n) return;
  const int64_t target = rows[row];
  for (int word = int(threadIdx.x), i = 0; word < copies.words; word += kWarp) {
    while (word >= copies.last[i]) ++i;
    const int own = word - (i == 0 ? 0 : copies.last[i - 1]);
    const float value = reinterpret_cast<const float*>(copies.from[i])[row * copies.from_row[i] + own];
    // Places that no anchor was drawn for all name one row, and have zeros for it: they need not wait for one another.
    if (value != 0.f) atomicAdd(reinterpret_cast<float*>(copies.to[i]) + target * copies.to_row[i] + own, value);
  }
}

__device__ __forceinline__ float sigmoid(float x) { return 1.f / (1.f + expf(-x)); }

__device__ __forceinline__ int group_of(int column, int features) {
  return column < features ? 0 : column < features + 6 ? 1 : 2;
}

__device__ __forceinline__ float sum_of_warp(float value) {
#pragma unroll
  for (int lanes = kWarp / 2; lanes > 0; lanes /= 2) value += __shfl_xor_sync(kAll, value, lanes);
  return value;
}

__global__ void __launch_bounds__(kWarp* kRows)
    values_kernel(const __grid_constant__ Rows from, float* values, float* masks, float* kept) {
  const int64_t row = own_row();
  const int lane = int(threadIdx.x), f = from.features, k = from.offsets, numbers = f + 6 + 3 * k;
  const bool there = row < from.count;
  float any = 0.f;
  if (there) {
    for (int column = lane; column < numbers; column += kWarp) {
      const int group = group_of(column, f);
      float value = group == 0   ? from.feature_rows[row * f + column]
                    : group == 1 ? expf(from.log_scales[row * 6 + column - f])
                                 : from.offset_rows[row * 3 * k + column - f - 6];
      if (from.noise != nullptr)
        value += from.noise[row * numbers + column] * from.steps[row * from.step_row + group];
      values[row * numbers + column] = value;
    }
    const bool valid = from.valid == nullptr || float(row) < *from.valid;
    const float weight = from.weights == nullptr ? 1.f : from.weights[row];
    for (int j = lane; j < k; j += kWarp) {
      const float mask = valid && sigmoid(from.logits[row * k + j]) * weight > from.threshold ? 1.f : 0.f;
      masks[row * k + j] = mask;
      any += mask;
    }
  }
  any = sum_of_warp(any);
  if (there && lane == 0) kept[row] = any > 0.f ? 1.f : 0.f;
}

__device__ __forceinline__ float at_of(const Piece& piece, int64_t row, int column) {
  return piece.at == nullptr ? 0.f : piece.at[row * piece.row + column];
}

__global__ void __launch_bounds__(kWarp* kRows)
    values_backward_kernel(const __grid_constant__ Rows from, const __grid_constant__ RowSlopes by, RowGradients to) {
  const int64_t row = own_row();
  const int lane = int(threadIdx.x), f = from.features, k = from.offsets, numbers = f + 6 + 3 * k;
  const bool there = row < from.count;
  float sums[kGroups] = {};
  if (there) {
    for (int column = lane; column < numbers; column += kWarp) {
      const int group = group_of(column, f), first = group == 0 ? 0 : group == 1 ? f : f + 6, own = column - first;
      const float slope = at_of(by.all, row, column) + at_of(by.group[group], row, own);
      if (group == 0)
        to.features[row * f + own] = slope;
      else if (group == 1)
        to.log_scales[row * 6 + own] = slope * expf(from.log_scales[row * 6 + own]);
      else
        to.offsets[row * 3 * k + own] = slope;
      const float part = to.steps != nullptr ? slope * from.noise[row * numbers + column] : 0.f;
      sums[0] += group == 0 ? part : 0.f, sums[1] += group == 1 ? part : 0.f, sums[2] += group == 2 ? part : 0.f;
    }
    const bool valid = from.valid == nullptr || float(row) < *from.valid;
    const float weight = from.weights == nullptr ? 1.f : from.weights[row];
    for (int j = lane; j < k; j += kWarp) {
      const float soft = sigmoid(from.logits[row * k + j]);
      to.logits[row * k + j] = valid ? at_of(by.masks, row, j) * weight * soft * (1.f - soft) : 0.f;
    }
  }
  if (to.steps == nullptr) return;
#pragma unroll
  for (int group = 0; group < kGroups; ++group) {
    const float sum = sum_of_warp(sums[group]);
    if (there && lane == group) to.steps[row * kGroups + group] = sum;
  }
}

__global__ void __launch_bounds__(kWarp* kRows)
    sample_kernel(const __grid_constant__ Sample from, const __grid_constant__ SampleBits to) {
  const int64_t row = own_row();
  const int lane = int(threadIdx.x), f = from.features, k = from.offsets, numbers = f + 6 + 3 * k;
  const bool there = row < from.count;
  float bits[kGroups] = {}, steps[kGroups] = {};
  if (there) {
    const float counted = from.counted[row];
    // An item is a number, or an offset with its three coordinates, which share a mask.
    for (int item = lane; item < f + 6 + k; item += kWarp) {
      const int group = group_of(item, f);
      const int first = group < 2 ? item : f + 6 + 3 * (item - f - 6), last = group < 2 ? first + 1 : first + 3;
      const float factor = group < 2 ? counted : from.masks[row * k + item - f - 6];
      const float half = 0.5f * from.steps[row * kGroups + group];
      float own = 0.f, by_step = 0.f;
      for (int column = first; column < last; ++column) {
        const int64_t at = row * numbers + column;
        const float raw = from.scale[at], deviation = fmaxf(raw, from.smallest_scale);
        const float offset = from.x[at] - from.mean[at], away = fabsf(offset);
        const float narrow = 0.70710678118f / deviation;
        const float near = (away - half) * narrow, far = (away + half) * narrow;
        const float p = 0.5f * (erfcf(near) - erfcf(far)), bounded = fmaxf(p, from.smallest);
        own -= log2f(bounded);
        // Below its floor a probability still has the gradient that raises it: that of bits that count is negative.
        const float slope = factor * (-1.4426950409f * 0.56418958355f) / bounded;  // 1 / ln 2, 1 / sqrt(pi)
        const float at_near = slope * expf(-near * near), at_far = slope * expf(-far * far);
        const float by_x = (at_far - at_near) * narrow * (offset > 0.f ? 1.f : offset < 0.f ? -1.f : 0.f);
        to.x[at] = by_x, to.mean[at] = -by_x;
        to.scale[at] = raw >= from.smallest_scale ? (at_near * near - at_far * far) / deviation : 0.f;
        by_step += 0.5f * (at_near + at_far) * narrow;
      }
      if (group == 2) to.masks[row * k + item - f - 6] = own;
#pragma unroll
      for (int g = 0; g < kGroups; ++g)
        bits[g] += g == group ? factor * own : 0.f, steps[g] += g == group ? by_step : 0.f;
    }
  }
#pragma unroll
  for (int group = 0; group < kGroups; ++group) {
    const float sum = sum_of_warp(bits[group]), by_step = sum_of_warp(steps[group]);
    if (there && lane == group) to.bits[row * kGroups + group] = sum, to.steps[row * kGroups + group] = by_step;
  }
}

dim3 threads() { return {kWarp, kRows}; }
unsigned blocks_of(int64_t rows) { return unsigned((rows + kRows - 1) / kRows); }

}  // namespace

void clear(const RowCopies& copies, int64_t n, cudaStream_t stream) {
  if (n > 0) clear_kernel<<<blocks_of(n), threads(), 0, stream>>>(copies, n);
}

void gather(const RowCopies& copies, const int64_t* rows, int64_t n, cudaStream_t stream) {
  if (n > 0) copy_kernel<true><<<blocks_of(n), threads(), 0, stream>>>(copies, rows, n);
}

void scatter(const RowCopies& copies, const int64_t* rows, int64_t n, cudaStream_t stream) {
  if (n > 0) copy_kernel<false><<<blocks_of(n), threads(), 0, stream>>>(copies, rows, n);
}

void add(const RowCopies& copies, const int64_t* rows, int64_t n, cudaStream_t stream) {
  if (n > 0) add_kernel<<<blocks_of(n), threads(), 0, stream>>>(copies, rows, n);
}

void values(const Rows& from, float* values, float* masks, float* kept, cudaStream_t stream) {
  if (from.count > 0) values_kernel<<<blocks_of(from.count), threads(), 0, stream>>>(from, values, masks, kept);
}

void values_backward(const Rows& from, const RowSlopes& by, const RowGradients& to, cudaStream_t stream) {
  if (from.count > 0) values_backward_kernel<<<blocks_of(from.count), threads(), 0, stream>>>(from, by, to);
}

void sample_bits(const Sample& sample, const SampleBits& to, cudaStream_t stream) {
  if (sample.count > 0) sample_kernel<<<blocks_of(sample.count), threads(), 0, stream>>>(sample, to);
}

}  // namespace sw_anchors::cuda
