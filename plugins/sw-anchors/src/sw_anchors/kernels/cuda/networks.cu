// The three networks of anchors, in one pass each way over tiles of 64 anchors. A block keeps all weights in shared
// memory, and of a tile inputs, hidden layer and gradients, number by number: a thread takes four anchors, whose values
// are one load of sixteen bytes, times some columns. On the way back it keeps the gradients of its weights in registers
// until the block has no more tiles.
//
// Biases are weights of an input that is 1. Hidden layers stand side by side, kHiddenRoom numbers each; outputs too, each
// network's from `output_start` on. Numbers that no network has are 0.
#include "networks.h"

namespace sw_anchors::cuda {
namespace {

constexpr int kThreads = 256, kTile = 64, kSide = 16, kRow = kTile + 4;
constexpr int kHiddenRoom = kMostHidden + 1, kColumns = 160;  // 3 kHiddenRoom in groups of 16
constexpr int kOutputGroups = 8, kOutputRoom = 128;
constexpr int kInputs = 64, kInputsUsed = kMostInputs + 1, kHiddenRows = 2 * kHiddenRoom + 64;
constexpr int kFirstRow = kColumns + 4, kLastRow = kOutputRoom + 4;
// Numbers of shared memory: weights of the first layer [input][column], of the last [hidden][output]; inputs, hidden
// layer and gradients by the outputs, each [number][anchor].
constexpr int kAtFirst = 0, kAtLast = kAtFirst + kInputsUsed * kFirstRow;
constexpr int kAtInputs = kAtLast + kHiddenRoom * kLastRow, kAtHidden = kAtInputs + kInputs * kRow;
constexpr int kAtSlopes = kAtHidden + kHiddenRows * kRow, kShared = kAtSlopes + kOutputRoom * kRow;
constexpr int kHiddenGroups = kColumns / kSide;
// Sums of a block: [kColumns][kInputs] of the first layer, [outputs][64] of the last.
constexpr int kFirstSums = kColumns * kInputs, kSums = kFirstSums + kOutputRoom * 64;
static_assert(3 * kHiddenRoom <= kColumns && kHiddenRows >= kColumns && kAtLast % 4 == 0 && kAtInputs % 4 == 0 &&
              kAtHidden % 4 == 0 && kAtSlopes % 4 == 0 && kHiddenRoom % 4 == 0 && kInputsUsed % 4 == 0);

// Where the outputs of a network start, of all networks side by side.
constexpr __host__ __device__ __forceinline__ int output_start(int n) { return n == 0 ? 0 : n == 1 ? 16 : n == 2 ? 96 : 128; }
static_assert(output_start(1) == kMostOutputs[0] && output_start(2) - output_start(1) == kMostOutputs[1] &&
              output_start(3) - output_start(2) == kMostOutputs[2] && output_start(3) == kOutputRoom);

__device__ __forceinline__ const float4& four(const float* at) { return *reinterpret_cast<const float4*>(at); }

__device__ __forceinline__ int network_of_group(int group) { return group < 1 ? 0 : group < 6 ? 1 : 2; }

__device__ void load_weights(const Networks& networks, float* shared) {
  const int inputs = networks.features + 4, hidden = networks.hidden;
  for (int at = int(threadIdx.x); at < kAtInputs; at += kThreads) shared[at] = 0.f;
  __syncthreads();
  for (int n = 0; n < kNetworks; ++n) {
    for (int at = int(threadIdx.x); at < hidden * (inputs + 1); at += kThreads) {
      const int column = at / (inputs + 1), input = at % (inputs + 1);
      shared[kAtFirst + input * kFirstRow + n * kHiddenRoom + column] =
          input < inputs ? networks.first[n][column * inputs + input] : networks.first_bias[n][column];
    }
    for (int at = int(threadIdx.x); at < networks.outputs[n] * (hidden + 1); at += kThreads) {
      const int output = at / (hidden + 1), number = at % (hidden + 1);
      shared[kAtLast + number * kLastRow + output_start(n) + output] =
          number < hidden ? networks.last[n][output * hidden + number] : networks.last_bias[n][output];
    }
  }
}

__device__ void load_inputs(const Viewed& viewed, int features, int64_t start, float* inputs) {
  for (int at = int(threadIdx.x); at < kTile * kInputs; at += kThreads) {
    const int anchor = at / kInputs, number = at % kInputs;
    const bool there = start + anchor < viewed.count && number < features;
    inputs[number * kRow + anchor] = there ? viewed.features[(start + anchor) * viewed.row + number] : 0.f;
  }
  __syncthreads();
  const int anchor = int(threadIdx.x);
  if (anchor < kTile && start + anchor < viewed.count) {
    const float* position = viewed.positions + 3 * (start + anchor);
    const float x = position[0] - viewed.center[0], y = position[1] - viewed.center[1];
    const float z = position[2] - viewed.center[2], distance = sqrtf(x * x + y * y + z * z);
    float* to = inputs + features * kRow + anchor;
    to[0] = x / distance, to[kRow] = y / distance, to[2 * kRow] = z / distance, to[3 * kRow] = distance;
    to[4 * kRow] = 1.f;
  }
}

// sums[4 of anchors] += weight times four anchors.
__device__ __forceinline__ void add(float* sums, float weight, const float4& of) {
  sums[0] += weight * of.x, sums[1] += weight * of.y, sums[2] += weight * of.z, sums[3] += weight * of.w;
}

__device__ __forceinline__ float dot(const float4& a, const float4& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w;
}

__device__ __forceinline__ void put(float* to, const float* sums) {
  *reinterpret_cast<float4*>(to) = make_float4(sums[0], sums[1], sums[2], sums[3]);
}

// Hidden layers of a tile; thread x takes columns 4 x .., 64 + 4 x .. and 128 + 2 x ...
__device__ void hidden_layers(int hidden, const float* first, const float* inputs, float* to) {
  const int x = int(threadIdx.x) % kSide, anchors = int(threadIdx.x) / kSide * 4;
  float sums[10][4] = {};
#pragma unroll 4
  for (int input = 0; input < kInputsUsed; ++input) {
    const float4 of = four(inputs + input * kRow + anchors);
    const float* row = first + input * kFirstRow;
    const float4 a = four(row + 4 * x), b = four(row + 64 + 4 * x);
    const float2 c = *reinterpret_cast<const float2*>(row + 128 + 2 * x);
    const float weights[10] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y};
#pragma unroll
    for (int i = 0; i < 10; ++i) add(sums[i], weights[i], of);
  }
#pragma unroll
  for (int i = 0; i < 10; ++i) {
    const int column = i < 4 ? 4 * x + i : i < 8 ? 60 + 4 * x + i : 120 + 2 * x + i;
    const bool is_one = column % kHiddenRoom == hidden && column < 3 * kHiddenRoom;
#pragma unroll
    for (int j = 0; j < 4; ++j) sums[i][j] = is_one ? 1.f : fmaxf(sums[i][j], 0.f);
    put(to + column * kRow + anchors, sums[i]);
  }
}

__global__ void __launch_bounds__(kThreads)
    forward_kernel(const __grid_constant__ Viewed viewed, const __grid_constant__ Networks networks, Outputs to) {
  extern __shared__ __align__(16) float shared[];
  float* const inputs = shared + kAtInputs;
  float* const hidden = shared + kAtHidden;
  const int x = int(threadIdx.x) % kSide, anchors = int(threadIdx.x) / kSide * 4;
  load_weights(networks, shared);
  for (int64_t start = int64_t(blockIdx.x) * kTile; start < viewed.count; start += int64_t(gridDim.x) * kTile) {
    load_inputs(viewed, networks.features, start, inputs);
    __syncthreads();
    hidden_layers(networks.hidden, shared + kAtFirst, inputs, hidden);
    __syncthreads();
    float sums[kOutputGroups][4] = {};
#pragma unroll 2
    for (int number = 0; number <= networks.hidden; ++number) {
      const float* row = shared + kAtLast + number * kLastRow;
      float4 of[kNetworks];
#pragma unroll
      for (int n = 0; n < kNetworks; ++n) of[n] = four(hidden + (n * kHiddenRoom + number) * kRow + anchors);
#pragma unroll
      for (int group = 0; group < kOutputGroups; ++group)
        add(sums[group], row[kSide * group + x], of[network_of_group(group)]);
    }
#pragma unroll
    for (int group = 0; group < kOutputGroups; ++group) {
      const int n = network_of_group(group), output = kSide * group + x - output_start(n);
      if (output >= networks.outputs[n]) continue;
#pragma unroll
      for (int j = 0; j < 4; ++j)
        if (start + anchors + j < viewed.count)
          to.of[n][(start + anchors + j) * networks.outputs[n] + output] = n == 0 ? tanhf(sums[group][j]) : sums[group][j];
    }
    __syncthreads();  // before the next tile overwrites what others still read
  }
}

__global__ void __launch_bounds__(kThreads)
    backward_kernel(const __grid_constant__ Viewed viewed, const __grid_constant__ Networks networks,
                    const float* alpha, const __grid_constant__ Outputs slopes, float* to_features, float* partial) {
  extern __shared__ __align__(16) float shared[];
  float* const inputs = shared + kAtInputs;
  float* const hidden = shared + kAtHidden;
  float* const by_output = shared + kAtSlopes;
  const int x = int(threadIdx.x) % kSide, y = int(threadIdx.x) / kSide, anchors = 4 * y;
  // Of weights: column y + 16 i (output y + 16 i) and input x + 16 j (number x + 16 j of the hidden layer).
  float first_sums[kHiddenGroups][4] = {}, last_sums[kOutputGroups][4] = {};
  load_weights(networks, shared);
  for (int at = int(threadIdx.x); at < kHiddenRows * kRow; at += kThreads) hidden[at] = 0.f;

  for (int64_t start = int64_t(blockIdx.x) * kTile; start < viewed.count; start += int64_t(gridDim.x) * kTile) {
    load_inputs(viewed, networks.features, start, inputs);
#pragma unroll
    for (int n = 0; n < kNetworks; ++n) {
      const int outputs = networks.outputs[n], room = output_start(n + 1) - output_start(n);
      for (int at = int(threadIdx.x); at < kTile * room; at += kThreads) {
        const int anchor = at / room, output = at % room;
        float slope = 0.f;
        if (output < outputs && start + anchor < viewed.count) {
          const int64_t from = (start + anchor) * outputs + output;
          slope = slopes.of[n][from];
          if (n == 0) slope *= 1.f - alpha[from] * alpha[from];
        }
        by_output[(output_start(n) + output) * kRow + anchor] = slope;
      }
    }
    __syncthreads();
    hidden_layers(networks.hidden, shared + kAtFirst, inputs, hidden);
    __syncthreads();

    for (int anchor = 0; anchor < kTile; anchor += 4)
#pragma unroll
      for (int n = 0; n < kNetworks; ++n) {
        float4 of[4];
#pragma unroll
        for (int j = 0; j < 4; ++j) of[j] = four(hidden + (n * kHiddenRoom + x + kSide * j) * kRow + anchor);
#pragma unroll
        for (int group = 0; group < kOutputGroups; ++group)
          if (network_of_group(group) == n) {
            const float4 slope = four(by_output + (y + kSide * group) * kRow + anchor);
#pragma unroll
            for (int j = 0; j < 4; ++j) last_sums[group][j] += dot(slope, of[j]);
          }
      }

    // Gradients by the hidden layers: of each network numbers x + 16 j.
    float sums[kNetworks][4][4] = {};
#pragma unroll
    for (int n = 0; n < kNetworks; ++n)
      for (int output = output_start(n); output < output_start(n) + networks.outputs[n]; output += 4) {
        float4 of[4];
#pragma unroll
        for (int i = 0; i < 4; ++i) of[i] = four(by_output + (output + i) * kRow + anchors);
#pragma unroll
        for (int j = 0; j < 4; ++j) {
          const int number = x + kSide * j;
          if (number >= kHiddenRoom) continue;
          const float4 weights = four(shared + kAtLast + number * kLastRow + output);
          add(sums[n][j], weights.x, of[0]), add(sums[n][j], weights.y, of[1]);
          add(sums[n][j], weights.z, of[2]), add(sums[n][j], weights.w, of[3]);
        }
      }
    __syncthreads();  // all have taken their products with the hidden layers, which these now replace
#pragma unroll
    for (int n = 0; n < kNetworks; ++n)
#pragma unroll
      for (int j = 0; j < 4; ++j) {
        const int number = x + kSide * j;
        if (number >= kHiddenRoom) continue;
        float* const place = hidden + (n * kHiddenRoom + number) * kRow + anchors;
        const float4 was = four(place);
        const bool learns = number < networks.hidden;  // and not the 1 behind them
        *reinterpret_cast<float4*>(place) =
            make_float4(learns && was.x > 0.f ? sums[n][j][0] : 0.f, learns && was.y > 0.f ? sums[n][j][1] : 0.f,
                        learns && was.z > 0.f ? sums[n][j][2] : 0.f, learns && was.w > 0.f ? sums[n][j][3] : 0.f);
      }
    __syncthreads();

    for (int anchor = 0; anchor < kTile; anchor += 4) {
      float4 of[4];
#pragma unroll
      for (int j = 0; j < 4; ++j) of[j] = four(inputs + (x + kSide * j) * kRow + anchor);
#pragma unroll
      for (int group = 0; group < kHiddenGroups; ++group) {
        const float4 slope = four(hidden + (y + kSide * group) * kRow + anchor);
#pragma unroll
        for (int j = 0; j < 4; ++j) first_sums[group][j] += dot(slope, of[j]);
      }
    }

    float by_input[4][4] = {};
    for (int column = 0; column < kColumns; column += 4) {
      float4 of[4];
#pragma unroll
      for (int i = 0; i < 4; ++i) of[i] = four(hidden + (column + i) * kRow + anchors);
#pragma unroll
      for (int j = 0; j < 4; ++j) {
        const int input = x + kSide * j;
        if (input >= kInputsUsed) continue;
        const float4 weights = four(shared + kAtFirst + input * kFirstRow + column);
        add(by_input[j], weights.x, of[0]), add(by_input[j], weights.y, of[1]);
        add(by_input[j], weights.z, of[2]), add(by_input[j], weights.w, of[3]);
      }
    }
#pragma unroll
    for (int j = 0; j < 4; ++j)
#pragma unroll
      for (int i = 0; i < 4; ++i)
        if (x + kSide * j < networks.features && start + anchors + i < viewed.count)
          to_features[(start + anchors + i) * networks.features + x + kSide * j] = by_input[j][i];
    __syncthreads();  // before the next tile overwrites what others still read
  }

  float* const to = partial + int64_t(blockIdx.x) * kSums;
#pragma unroll
  for (int group = 0; group < kHiddenGroups; ++group)
#pragma unroll
    for (int j = 0; j < 4; ++j) to[(y + kSide * group) * kInputs + x + kSide * j] = first_sums[group][j];
#pragma unroll
  for (int group = 0; group < kOutputGroups; ++group)
#pragma unroll
    for (int j = 0; j < 4; ++j) to[kFirstSums + (y + kSide * group) * 64 + x + kSide * j] = last_sums[group][j];
}

// A thread a parameter: the sum of all blocks.
__global__ void __launch_bounds__(kThreads)
    sum_kernel(const __grid_constant__ Networks networks, const __grid_constant__ Layout layout, const float* partial,
               int parts, float* to) {
  const int at = int(blockIdx.x) * kThreads + int(threadIdx.x), hidden = networks.hidden;
  if (at >= layout.total) return;
  int piece = 0;
  while (piece + 1 < kPieces && at >= layout.start[piece + 1]) ++piece;
  const int n = piece / 4, own = at - layout.start[piece], inputs = networks.features + 4;
  int from = 0, count = 0;
  if (piece % 4 == 0)
    from = (n * kHiddenRoom + own / inputs) * kInputs + own % inputs, count = hidden * inputs;
  else if (piece % 4 == 1)
    from = (n * kHiddenRoom + own) * kInputs + inputs, count = hidden;
  else if (piece % 4 == 2)
    from = kFirstSums + (output_start(n) + own / hidden) * 64 + own % hidden, count = networks.outputs[n] * hidden;
  else
    from = kFirstSums + (output_start(n) + own) * 64 + hidden, count = networks.outputs[n];
  float sum = 0.f;
  if (own < count)
    for (int part = 0; part < parts; ++part) sum += partial[int64_t(part) * kSums + from];
  to[at] = sum;
}

}  // namespace

const int kPartial = kSums;

int networks_bytes() { return kShared * int(sizeof(float)); }

int networks_parts(int64_t count) {
  int device = 0, processors = 1;
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device);
  const int64_t tiles = (count + kTile - 1) / kTile;
  return int(tiles < processors ? tiles : processors);
}

Layout layout_of(const Networks& networks) {
  Layout layout{};
  for (int piece = 0; piece < kPieces; ++piece) {
    const int n = piece / 4, inputs = networks.features + 4, outputs = networks.outputs[n];
    const int sizes[4] = {networks.hidden * inputs, networks.hidden, outputs * networks.hidden, outputs};
    layout.start[piece] = layout.total;
    layout.total += (sizes[piece % 4] + 3) / 4 * 4;
  }
  return layout;
}

void networks_forward(const Viewed& viewed, const Networks& networks, const Outputs& to, cudaStream_t stream) {
  const int blocks = networks_parts(viewed.count), bytes = kAtSlopes * int(sizeof(float));
  if (blocks == 0) return;
  cudaFuncSetAttribute(forward_kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, bytes);
  forward_kernel<<<blocks, kThreads, bytes, stream>>>(viewed, networks, to);
}

void networks_backward(const Viewed& viewed, const Networks& networks, const float* alpha, const Outputs& slopes,
                       float* to_features, float* partial, float* to_parameters, cudaStream_t stream) {
  const int blocks = networks_parts(viewed.count), bytes = networks_bytes();
  const Layout layout = layout_of(networks);
  if (blocks > 0) {
    cudaFuncSetAttribute(backward_kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, bytes);
    backward_kernel<<<blocks, kThreads, bytes, stream>>>(viewed, networks, alpha, slopes, to_features, partial);
  }
  const int wide = (layout.total + kThreads - 1) / kThreads;
  sum_kernel<<<wide, kThreads, 0, stream>>>(networks, layout, partial, blocks, to_parameters);
}

}  // namespace sw_anchors::cuda
