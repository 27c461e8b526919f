// Gaussians that anchors spawn, and the gradient: a thread a Gaussian.
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

unsigned blocks_of(const Anchors& from) { return unsigned((from.count + kThreads - 1) / kThreads); }

}  // namespace

void spawn(const Anchors& from, const Gaussians& to, cudaStream_t stream) {
  if (from.count > 0) spawn_kernel<<<blocks_of(from), kThreads, 0, stream>>>(from, to);
}

void spawn_backward(const Anchors& from, const Gaussians& slope, const Gradients& to, cudaStream_t stream) {
  if (from.count > 0) backward_kernel<<<blocks_of(from), kThreads, 0, stream>>>(from, slope, to);
}

}  // namespace sw_anchors::cuda
