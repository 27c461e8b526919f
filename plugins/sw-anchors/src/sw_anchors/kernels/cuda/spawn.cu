// Gaussians that anchors spawn, and the gradient: a thread a Gaussian, or in order the Gaussians of an anchor.
#include "kernels.h"

namespace sw_anchors::cuda {
namespace {

constexpr int kThreads = 128;

__global__ void __launch_bounds__(kThreads) spawn_kernel(const __grid_constant__ Anchors from, Gaussians to) {
  const int64_t m = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (m < from.count) spawn_one(from, m, to);
}

struct AtomicAdd {
  __device__ __forceinline__ void operator()(float* place, float value) const { atomicAdd(place, value); }
};

__global__ void __launch_bounds__(kThreads)
    backward_kernel(const __grid_constant__ Anchors from, Gaussians slope, Gradients to) {
  const int64_t m = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (m < from.count) spawn_one_backward(from, m, slope, to, AtomicAdd{});
}

// The Gaussians of an anchor follow one another: the thread of the first of them goes through them all, and no other
// thread adds to what they share.
__global__ void __launch_bounds__(kThreads)
    ordered_backward_kernel(const __grid_constant__ Anchors from, Gaussians slope, Gradients to) {
  int64_t m = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (m >= from.count) return;
  const int64_t anchor = from.drawn[m] / from.k, end = (anchor + 1) * from.k;
  if (m > 0 && from.drawn[m - 1] >= anchor * from.k) return;
  const auto add = [](float* place, float value) { *place += value; };
  for (; m < from.count && from.drawn[m] < end; ++m) spawn_one_backward(from, m, slope, to, add);
}

unsigned blocks_of(const Anchors& from) { return unsigned((from.count + kThreads - 1) / kThreads); }

}  // namespace

void spawn(const Anchors& from, const Gaussians& to, cudaStream_t stream) {
  if (from.count > 0) spawn_kernel<<<blocks_of(from), kThreads, 0, stream>>>(from, to);
}

void spawn_backward(const Anchors& from, const Gaussians& slope, const Gradients& to, bool ordered,
                    cudaStream_t stream) {
  const auto kernel = ordered ? ordered_backward_kernel : backward_kernel;
  if (from.count > 0) kernel<<<blocks_of(from), kThreads, 0, stream>>>(from, slope, to);
}

}  // namespace sw_anchors::cuda
