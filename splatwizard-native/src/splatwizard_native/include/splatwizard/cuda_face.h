// For the file behind a plain C face on a GPU: how an operation begins there, and what becomes of CUDA's errors.
//
//   SW_OPERATION(my_module_cuda, scale) {
//     return splatwizard::guarded_on_gpu(call, [&](cudaStream_t stream) {
//       kernels::scale(call->x, call->count, stream);
//     });
//   }
//
// Nothing here waits for the device or allocates on it, so that a CUDA graph may record the call.
#pragma once
#include <cuda_runtime_api.h>

#include <splatwizard/c_face.h>

namespace splatwizard {

inline void check(cudaError_t status) {
  if (status == cudaSuccess) return;
  cudaGetLastError();  // it is told once, and not by the next call again
  refuse("CUDA: %s", cudaGetErrorString(status));
}

// The GPU of a call, and afterwards that of before: the thread is torch's.
class OnGpu {
 public:
  explicit OnGpu(int device) : device_(device) {
    check(cudaGetDevice(&before_));
    check(cudaSetDevice(device));
  }
  ~OnGpu() {
    if (before_ != device_) cudaSetDevice(before_);
  }
  OnGpu(const OnGpu&) = delete;
  OnGpu& operator=(const OnGpu&) = delete;

 private:
  int device_, before_ = -1;
};

// The body of an operation: body(stream), which launches. Launches that fail become a status and a text.
template <class Call, class Body>
int32_t guarded_on_gpu(const Call* call, const Body& body) noexcept {
  return guarded(call, [&](const Parallel&) {
    const OnGpu there(call->head.device);
    body(static_cast<cudaStream_t>(call->head.stream));
    check(cudaGetLastError());
  });
}

}  // namespace splatwizard
