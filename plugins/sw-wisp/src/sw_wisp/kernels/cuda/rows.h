// The kernels of rows.cu.
#pragma once

#include <cuda_runtime_api.h>

#include "../kernels.h"

namespace sw_wisp::cuda {

void eight_bits(const Matrices& of, cudaStream_t stream);
void draw(const Draw& of, cudaStream_t stream);
void draw_backward(const DrawBack& of, cudaStream_t stream);
void bits(const CountedRows& of, cudaStream_t stream);
void bits_backward(const CountedRows& of, cudaStream_t stream);
void splats(const Splats& of, cudaStream_t stream);
void splats_backward(const SplatsBack& of, cudaStream_t stream);

}  // namespace sw_wisp::cuda
