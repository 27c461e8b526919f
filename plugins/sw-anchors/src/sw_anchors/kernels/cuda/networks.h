// The three networks of anchors on CUDA: plain pointers and a stream, no torch.
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>

namespace sw_anchors::cuda {

constexpr int kNetworks = 3;                            // opacity, covariance, colour
constexpr int kMostInputs = 55, kMostHidden = 51;       // that the kernels have room for
constexpr int kMostOutputs[kNetworks] = {16, 80, 32};
constexpr int kPieces = 4 * kNetworks;                  // weight and bias of both layers of each network

// Linear, ReLU, Linear; weights [outputs, inputs] row by row.
struct Networks {
  int features, hidden;  // inputs are these, direction and distance
  int outputs[kNetworks];
  const float *first[kNetworks], *first_bias[kNetworks], *last[kNetworks], *last_bias[kNetworks];
};

// Anchors of a view: `count` positions [.,3], features in rows `row` apart.
struct Viewed {
  int64_t count, row;
  const float *center, *positions, *features;
};

struct Outputs {  // [count, outputs] of each network
  float* of[kNetworks];
};

// Where the gradients by the parameters start in one row of numbers, in the order first, its bias, last, its bias of
// each network; each at a multiple of four numbers.
struct Layout {
  int start[kPieces], total;
};
Layout layout_of(const Networks& networks);

// Rows of `partial` that `networks_backward` needs, each `kPartial` numbers.
extern const int kPartial;
int networks_parts(int64_t count);
// Bytes of shared memory a block of it takes.
int networks_bytes();

// Outputs; tanh of the first network's.
void networks_forward(const Viewed& viewed, const Networks& networks, const Outputs& to, cudaStream_t stream);
// From outputs of the first network and the gradients by all outputs: those by features [count, features], and by the
// parameters as `layout_of` has them. Sums are the same each time.
void networks_backward(const Viewed& viewed, const Networks& networks, const float* alpha, const Outputs& slopes,
                       float* to_features, float* partial, float* to_parameters, cudaStream_t stream);

}  // namespace sw_anchors::cuda
