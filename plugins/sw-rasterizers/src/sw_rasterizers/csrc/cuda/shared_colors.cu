// Colours from codebooks: a thread a Gaussian reads its entry where it is; entries stay in the caches.
//
// The gradient of an entry is the sum over its users, whose order the caller gives: the same bits in every run. A warp
// adds up kRunUsers of them, one value of the entry a lane. An entry whose users begin before the warp's run goes into
// the run's carry instead, and a second kernel adds the carries of each entry in the order of the runs.
#include "shared_colors.h"

#include "../sh.h"
#include "device.h"

namespace sw::cuda {
namespace {

constexpr int kThreads = 128, kWarps = kThreads / kWarp;
constexpr int kOwn = kMaxBasis + 3;  // a user's basis and passed gradient; odd: no bank conflicts
static_assert(kEntryFloats == 3 * kMaxBasis && kEntryFloats <= 2 * kWarp);

// Unit vector from the camera to Gaussian n; returns 1 / distance.
__device__ __forceinline__ float direction_of(const SharedColors<float>& in, int64_t n, float* direction) {
  float squared = 0.f;
#pragma unroll
  for (int j = 0; j < 3; ++j) {
    direction[j] = in.means[3 * n + j] - in.center[j];
    squared += direction[j] * direction[j];
  }
  const float inverse = 1.f / square_root(squared);
#pragma unroll
  for (int j = 0; j < 3; ++j) direction[j] *= inverse;
  return inverse;
}

// Value 3 k + channel of the coefficients of Gaussian n.
__device__ __forceinline__ const float* coefficients_of(const SharedColors<float>& in, int64_t n, int k) {
  return k < in.first ? in.dc + 3 * n : in.codebook + in.rows[n] * in.stride + 3 * (k - in.first);
}

template <int kDegree>
__device__ __forceinline__ void color_of(const SharedColors<float>& in, int64_t n, const float* basis, float* color) {
  color[0] = color[1] = color[2] = 0.5f;
#pragma unroll
  for (int k = 0; k < (kDegree + 1) * (kDegree + 1); ++k) {
    const float* sh = coefficients_of(in, n, k);
#pragma unroll
    for (int c = 0; c < 3; ++c) color[c] += basis[k] * sh[c];
  }
}

template <int kDegree>
__global__ void __launch_bounds__(kThreads) shade_kernel(SharedColors<float> in, float* colors) {
  const int64_t n = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (n >= in.count) return;
  float direction[3] = {}, basis[kMaxBasis], color[3];
  if (kDegree > 0) direction_of(in, n, direction);
  sh_basis(kDegree, direction[0], direction[1], direction[2], basis);
  color_of<kDegree>(in, n, basis, color);
#pragma unroll
  for (int c = 0; c < 3; ++c) colors[3 * n + c] = in.clamp && color[c] < 0.f ? 0.f : color[c];
}

// `passed`: the gradient without what the clamp stops.
template <int kDegree>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(SharedColors<float> in, const float* gradient, float* passed, float* means, float* dc) {
  constexpr int kBasis = (kDegree + 1) * (kDegree + 1);
  const int64_t n = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (n >= in.count) return;
  float g[3], slope[3] = {};
#pragma unroll
  for (int c = 0; c < 3; ++c) g[c] = gradient[3 * n + c];
  // Not seen: nothing is read, and a mean in the camera's centre, which has no direction, does no harm.
  if (g[0] != 0.f || g[1] != 0.f || g[2] != 0.f) {
    float direction[3] = {}, basis[kMaxBasis], color[3], inverse = 0.f;
    if (kDegree > 0) inverse = direction_of(in, n, direction);
    sh_basis(kDegree, direction[0], direction[1], direction[2], basis);
    if (in.clamp) {
      color_of<kDegree>(in, n, basis, color);
#pragma unroll
      for (int c = 0; c < 3; ++c)
        if (color[c] < 0.f) g[c] = 0.f;
    }
    if (kDegree > 0 && (g[0] != 0.f || g[1] != 0.f || g[2] != 0.f)) {
      float dx[kMaxBasis], dy[kMaxBasis], dz[kMaxBasis];
      sh_basis_gradient(kDegree, direction[0], direction[1], direction[2], dx, dy, dz);
#pragma unroll
      for (int k = 1; k < kBasis; ++k) {
        const float* sh = coefficients_of(in, n, k);
        const float along = sh[0] * g[0] + sh[1] * g[1] + sh[2] * g[2];
        slope[0] += dx[k] * along, slope[1] += dy[k] * along, slope[2] += dz[k] * along;
      }
      const float radial = direction[0] * slope[0] + direction[1] * slope[1] + direction[2] * slope[2];
#pragma unroll
      for (int j = 0; j < 3; ++j) slope[j] = (slope[j] - direction[j] * radial) * inverse;
    }
  }
#pragma unroll
  for (int c = 0; c < 3; ++c) {
    passed[3 * n + c] = g[c], means[3 * n + c] = slope[c];
    if (dc != nullptr) dc[3 * n + c] = float(kSH0) * g[c];
  }
}

// A lane's part of an entry: values `lane` and `lane + 32`.
struct Part {
  float values[2] = {0.f, 0.f};

  __device__ __forceinline__ void store(float* to, int floats) const {
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      const int value = lane_index() + half * kWarp;
      if (value < floats) to[value] = values[half];
    }
  }
};

template <int kDegree>
__global__ void __launch_bounds__(kThreads)
    codebook_kernel(SharedColors<float> in, const int64_t* order, const int64_t* offsets, const float* passed,
                    float* codebook, float* carried) {
  constexpr int kBasis = (kDegree + 1) * (kDegree + 1);
  __shared__ float staged[kWarps][kWarp * kOwn];
  __shared__ int entries[kWarps][kWarp];
  const int64_t run = int64_t(blockIdx.x) * kWarps + warp_index(), begin = run * kRunUsers;
  if (begin >= in.count) return;
  const int64_t end = min(begin + kRunUsers, in.count);
  float* const shared = staged[warp_index()];
  int* const entry_of = entries[warp_index()];
  const int lane = lane_index(), floats = 3 * (kBasis - in.first);
  // Where this lane's two values stand among a user's numbers.
  int basis_at[2], color_at[2];
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    const int value = min(lane + half * kWarp, max(floats - 1, 0));
    basis_at[half] = min(in.first + value / 3, kBasis - 1), color_at[half] = kMaxBasis + value % 3;
  }

  Part sum;
  int entry = int(in.rows[order[begin]]);
  bool continued = offsets[entry] < begin;
  const auto finish = [&] {
    sum.store(continued ? carried + run * kEntryFloats : codebook + int64_t(entry) * in.stride, floats);
  };
  for (int64_t from = begin; from < end; from += kWarp) {
    const int held = int(min(int64_t(kWarp), end - from));
    __syncwarp();  // all have used the users before
    if (lane < held) {
      const int64_t n = order[from + lane];
      float* mine = shared + lane * kOwn;
      float g[3], direction[3] = {}, basis[kMaxBasis] = {};
#pragma unroll
      for (int c = 0; c < 3; ++c) g[c] = passed[3 * n + c];
      if (g[0] != 0.f || g[1] != 0.f || g[2] != 0.f) {
        if (kDegree > 0) direction_of(in, n, direction);
        sh_basis(kDegree, direction[0], direction[1], direction[2], basis);
      }
#pragma unroll
      for (int k = 0; k < kBasis; ++k) mine[k] = basis[k];
#pragma unroll
      for (int c = 0; c < 3; ++c) mine[kMaxBasis + c] = g[c];
      entry_of[lane] = int(in.rows[n]);
    }
    __syncwarp();
    for (int i = 0; i < held; ++i) {
      if (entry_of[i] != entry) {
        finish();
        sum = Part(), entry = entry_of[i], continued = false;
      }
      const float* user = shared + i * kOwn;
#pragma unroll
      for (int half = 0; half < 2; ++half) sum.values[half] += user[basis_at[half]] * user[color_at[half]];
    }
  }
  finish();
}

// A warp an entry: adds what the runs behind its first one carried.
__global__ void __launch_bounds__(kThreads)
    carry_kernel(SharedColors<float> in, const int64_t* offsets, int floats, const float* carried, float* codebook) {
  const int64_t entry = int64_t(blockIdx.x) * kWarps + warp_index();
  if (entry >= in.entries) return;
  const int64_t begin = offsets[entry], end = offsets[entry + 1];
  if (begin == end) return;
  const int64_t first = begin / kRunUsers, last = (end - 1) / kRunUsers;
  for (int value = lane_index(); first < last && value < floats; value += kWarp) {
    float sum = codebook[entry * in.stride + value];
#pragma unroll 8
    for (int64_t run = first + 1; run <= last; ++run) sum += carried[run * kEntryFloats + value];
    codebook[entry * in.stride + value] = sum;
  }
}

}  // namespace

void shade_shared(const SharedColors<float>& in, float* colors, cudaStream_t stream) {
  const auto kernel = in.degree == 0   ? shade_kernel<0>
                      : in.degree == 1 ? shade_kernel<1>
                      : in.degree == 2 ? shade_kernel<2>
                                       : shade_kernel<3>;
  kernel<<<unsigned(ceil_div(in.count, kThreads)), kThreads, 0, stream>>>(in, colors);
}

void shade_shared_backward(const SharedColors<float>& in, const float* gradient, float* passed, float* means, float* dc,
                           cudaStream_t stream) {
  const auto kernel = in.degree == 0   ? backward_kernel<0>
                      : in.degree == 1 ? backward_kernel<1>
                      : in.degree == 2 ? backward_kernel<2>
                                       : backward_kernel<3>;
  kernel<<<unsigned(ceil_div(in.count, kThreads)), kThreads, 0, stream>>>(in, gradient, passed, means, dc);
}

void add_to_codebook(const SharedColors<float>& in, const int64_t* order, const int64_t* offsets, const float* passed,
                     float* codebook, float* carried, cudaStream_t stream) {
  const auto kernel = in.degree == 0   ? codebook_kernel<0>
                      : in.degree == 1 ? codebook_kernel<1>
                      : in.degree == 2 ? codebook_kernel<2>
                                       : codebook_kernel<3>;
  const int64_t runs = ceil_div(in.count, kRunUsers);
  kernel<<<unsigned(ceil_div(runs, kWarps)), kThreads, 0, stream>>>(in, order, offsets, passed, codebook, carried);
  const int floats = 3 * ((in.degree + 1) * (in.degree + 1) - in.first);
  carry_kernel<<<unsigned(ceil_div(in.entries, kWarps)), kThreads, 0, stream>>>(in, offsets, floats, carried, codebook);
}

}  // namespace sw::cuda
