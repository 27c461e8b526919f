// The three networks of anchors on tensor cores, in one pass each way. A warp takes 16 anchors, or 16 rows of weights'
// gradients, which stay in registers until the block has no more tiles of 64 anchors; a block keeps all weights in
// shared memory. Tensor cores round factors to 11 bits: each is taken as the sum of two such numbers, of whose four
// products the smallest is left out, which leaves the accuracy of float32. Needs sm_80.
//
// Biases are weights of an input that is 1. Hidden layers stand side by side, kHidden numbers each; outputs too, each
// network's from `output_start` on. Numbers that no network has are 0. Rows in shared memory are 8 or 24 numbers longer
// than a multiple of 32: then the 8 next numbers of 4 rows, one below the other, share no bank.
#include "networks.h"

#include <cuda_pipeline_primitives.h>

namespace sw_anchors::cuda {
namespace {

constexpr int kTile = 64, kGroup = 16, kSumThreads = 256;
constexpr int kInputs = 56, kHidden = 56, kColumns = kNetworks * kHidden, kOutputs = 128, kSlopeRow = kOutputs + 8;
constexpr int kWidth = 7, kSteps = 7;  // eights of inputs and of a hidden layer
static_assert(kMostInputs < kInputs && kMostHidden < kHidden && 8 * kWidth == kHidden && 8 * kSteps == kInputs);

// Numbers of shared memory on the way back: inputs, gradients by outputs and hidden layers, each [anchor][number];
// weights [column][input] and [hidden number][output]; alpha. The last of 16 columns at a time end behind the hidden
// layers.
constexpr int kAtSlopes = kTile * kInputs, kAtColumns = kAtSlopes + kTile * kSlopeRow;
constexpr int kAtFirst = kAtColumns + kTile * kColumns, kAtLast = kAtFirst + kColumns * kInputs;
constexpr int kAtAlpha = kAtLast + kHidden * kSlopeRow, kAlphas = kMostOutputs[0];
constexpr int kShared = kAtAlpha + kTile * kAlphas;
// On the way forth: weights [column][input] and [output][hidden number], inputs of each warp.
constexpr int kForwardWarps = 16, kForwardLast = kColumns * kInputs;
constexpr int kForwardInputs = kForwardLast + kOutputs * kHidden;
constexpr int kForwardShared = kForwardInputs + kForwardWarps * kGroup * kInputs;
static_assert(kShared * sizeof(float) == 164'352 && kForwardShared <= kShared);  // BLOCK_BYTES of view_networks.py
// A warp for each network of 16 anchors; sums of a block: [kOutputs][kHidden] and [kColumns, in sixteens][kInputs].
constexpr int kRowGroups = kTile / kGroup, kBackwardWarps = kRowGroups * kNetworks;
constexpr int kColumnGroups = (kColumns + kGroup - 1) / kGroup, kFirstSums = kOutputs * kHidden;
constexpr int kSums = kFirstSums + kColumnGroups * kGroup * kInputs;

// Where the outputs of a network start, of all networks side by side.
constexpr __host__ __device__ __forceinline__ int output_start(int n) {
  return n == 0 ? 0 : n == 1 ? 16 : n == 2 ? 96 : 128;
}
static_assert(output_start(1) == kMostOutputs[0] && output_start(2) - output_start(1) == kMostOutputs[1] &&
              output_start(3) - output_start(2) == kMostOutputs[2] && output_start(3) == kOutputs);

// A number as the sum of two: of 11 bits, and what it lacks.
struct Parts {
  unsigned big, small;
};

__device__ __forceinline__ Parts parts_of(float number) {
  const unsigned big = (__float_as_uint(number) + 0x1000u) & 0xffffe000u;  // to nearest
  return {big, __float_as_uint(number - __uint_as_float(big))};  // tensor cores drop the last 13 bits by themselves
}

// d += a b, 16 by 8 of 8 products each. Of lane l, with r = l / 4 and q = l % 4: d has row r, columns 2 q and 2 q + 1,
// then row r + 8; a has rows r and r + 8 at q, then at q + 4; b has q and q + 4 of column r.
__device__ __forceinline__ void multiply(float (&d)[4], unsigned a0, unsigned a1, unsigned a2, unsigned a3, unsigned b0,
                                         unsigned b1) {
#if __CUDA_ARCH__ >= 800
  // volatile: in the order given, since a product waits for the one before it with the same sums.
  asm volatile(
      "mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
      "{%0, %1, %2, %3};"
      : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
      : "r"(a0), "r"(a1), "r"(a2), "r"(a3), "r"(b0), "r"(b1));
#else
  __trap();  // declared for compute capability 8.0 and up
#endif
}

// The same with float32 factors, for columns in eights; `rest` gets the small products, and may be d.
template <int kCount>
__device__ __forceinline__ void multiply(float (&d)[kCount][4], float (&rest)[kCount][4], const Parts (&a)[4],
                                         const float2 (&b)[kCount]) {
  Parts first[kCount], second[kCount];
#pragma unroll
  for (int i = 0; i < kCount; ++i) first[i] = parts_of(b[i].x), second[i] = parts_of(b[i].y);
#pragma unroll
  for (int i = 0; i < kCount; ++i)
    multiply(rest[i], a[0].small, a[1].small, a[2].small, a[3].small, first[i].big, second[i].big);
#pragma unroll
  for (int i = 0; i < kCount; ++i)
    multiply(rest[i], a[0].big, a[1].big, a[2].big, a[3].big, first[i].small, second[i].small);
#pragma unroll
  for (int i = 0; i < kCount; ++i)
    multiply(d[i], a[0].big, a[1].big, a[2].big, a[3].big, first[i].big, second[i].big);
}

__device__ __forceinline__ const float2& two(const float* at) { return *reinterpret_cast<const float2*>(at); }

// Numbers `at` and the next of two rows, 8 apart, in the places q and q + 4 of a: so b must have them too.
__device__ __forceinline__ void take_rows(Parts (&a)[4], const float* at, int row) {
  const float2 upper = two(at), lower = two(at + 8 * row);
  a[0] = parts_of(upper.x), a[1] = parts_of(lower.x), a[2] = parts_of(upper.y), a[3] = parts_of(lower.y);
}

struct Lane {
  int row = int(threadIdx.x) % 32 / 4, quarter = int(threadIdx.x) % 4, pair = 2 * quarter;
};

// Copies weights row by row, the biases behind them; wait for it.
__device__ void load_layer(const float* weights, const float* biases, int rows, int columns, float* to, int row,
                           int column) {
  for (int at = int(threadIdx.x); at < rows * (columns + 1); at += int(blockDim.x)) {
    const int r = at / (columns + 1), c = at % (columns + 1);
    __pipeline_memcpy_async(to + r * row + c * column, c < columns ? weights + r * columns + c : biases + r, 4);
  }
}

__device__ void load_first(const Networks& networks, float* to) {
  for (int n = 0; n < kNetworks; ++n)
    load_layer(networks.first[n], networks.first_bias[n], networks.hidden, networks.features + 4,
               to + n * kHidden * kInputs, kInputs, 1);
}

__device__ void clear(float* to, int count) {
  for (int at = int(threadIdx.x); at < count; at += int(blockDim.x)) to[at] = 0.f;
  __syncthreads();
}

// Copies features of anchors from `start` on, without what `load_directions` puts behind them; wait for it.
template <int kRows>
__device__ void load_features(const Viewed& viewed, int features, int64_t start, int thread, int threads, float* to) {
  for (int at = thread; at < kRows * kInputs; at += threads) {
    const int anchor = at / kInputs, number = at % kInputs;
    const bool there = start + anchor < viewed.count;
    if (there && number < features)
      __pipeline_memcpy_async(to + at, viewed.features + (start + anchor) * viewed.row + number, 4);
    else if (!there || number > features + 4)
      to[at] = 0.f;
  }
}

template <int kRows>
__device__ void load_directions(const Viewed& viewed, int features, int64_t start, int anchor, float* to) {
  if (anchor >= kRows || start + anchor >= viewed.count) return;
  const float* position = viewed.positions + 3 * (start + anchor);
  const float x = position[0] - viewed.center[0], y = position[1] - viewed.center[1];
  const float z = position[2] - viewed.center[2], distance = sqrtf(x * x + y * y + z * z);
  to += anchor * kInputs + features;
  to[0] = x / distance, to[1] = y / distance, to[2] = z / distance, to[3] = distance, to[4] = 1.f;
}

// Copies numbers that belong to the outputs of network n; wait for it.
template <int n>
__device__ void load_outputs(const float* from, int outputs, int64_t start, int64_t count, float* to, int row) {
  constexpr int kRoom = output_start(n + 1) - output_start(n);
  for (int at = int(threadIdx.x); at < kTile * kRoom; at += int(blockDim.x)) {
    const int anchor = at / kRoom, output = at % kRoom;
    float* const place = to + anchor * row + output;
    if (output < outputs && start + anchor < count)
      __pipeline_memcpy_async(place, from + (start + anchor) * outputs + output, 4);
    else
      *place = 0.f;
  }
}

// Hidden layer of a network for 16 anchors: 8 numbers and 16 anchors each, as `multiply` has them.
__device__ __forceinline__ void hidden_layer(int hidden, const float* first, const float* inputs,
                                             float (&sums)[kWidth][4]) {
  const Lane lane;
  // Apart, since a number near 0 may change its sign by what sums of both lose.
  float rest[kWidth][4] = {};
#pragma unroll
  for (int i = 0; i < kWidth; ++i) sums[i][0] = sums[i][1] = sums[i][2] = sums[i][3] = 0.f;
  inputs += lane.row * kInputs + lane.pair, first += lane.row * kInputs + lane.pair;
#pragma unroll 1
  for (int step = 0; step < kSteps; ++step) {
    Parts a[4];
    float2 b[kWidth];
    take_rows(a, inputs + 8 * step, kInputs);
#pragma unroll
    for (int i = 0; i < kWidth; ++i) b[i] = two(first + 8 * (i * kInputs + step));
    multiply(sums, rest, a, b);
  }
#pragma unroll
  for (int i = 0; i < kWidth; ++i)
#pragma unroll
    for (int j = 0; j < 4; ++j)
      sums[i][j] = 8 * i + lane.pair + j % 2 == hidden ? 1.f : fmaxf(sums[i][j] + rest[i][j], 0.f);
}

__global__ void __launch_bounds__(32 * kForwardWarps)
    forward_kernel(const __grid_constant__ Viewed viewed, const __grid_constant__ Networks networks,
                   const __grid_constant__ Outputs to) {
  extern __shared__ __align__(16) float shared[];
  const Lane lane;
  const int warp = int(threadIdx.x) / 32, thread = int(threadIdx.x) % 32;
  float* const inputs = shared + kForwardInputs + warp * kGroup * kInputs;
  const float* const last = shared + kForwardLast + lane.row * kHidden + lane.pair;
  clear(shared, kForwardInputs);
  load_first(networks, shared);
  for (int n = 0; n < kNetworks; ++n)
    load_layer(networks.last[n], networks.last_bias[n], networks.outputs[n], networks.hidden,
               shared + kForwardLast + output_start(n) * kHidden, kHidden, 1);
  __pipeline_commit();
  __pipeline_wait_prior(0);
  __syncthreads();
  // A block's neighbours take the next anchors: then all processors share what is left of them.
  const int64_t apart = int64_t(gridDim.x) * kGroup;
  const int64_t own = int64_t(blockIdx.x) * kGroup;
  for (int64_t start = warp * apart + own; start < viewed.count; start += kForwardWarps * apart) {
    load_features<kGroup>(viewed, networks.features, start, thread, 32, inputs);
    __pipeline_commit();
    load_directions<kGroup>(viewed, networks.features, start, thread, inputs);
    __pipeline_wait_prior(0);
    __syncwarp();
#pragma unroll 1
    for (int n = 0; n < kNetworks; ++n) {
      float hidden[kWidth][4];
      hidden_layer(networks.hidden, shared + n * kHidden * kInputs, inputs, hidden);
      Parts a[kWidth][4];  // the lane has just those numbers that `take_rows` would give it
#pragma unroll
      for (int i = 0; i < kWidth; ++i)
#pragma unroll
        for (int j = 0; j < 4; ++j) a[i][j] = parts_of(hidden[i][j % 2 * 2 + j / 2]);
      const int outputs = networks.outputs[n];
#pragma unroll 1
      for (int output = 0; output < outputs; output += 16) {
        float sums[2][4] = {}, rest[2][4] = {};
#pragma unroll
        for (int step = 0; step < kWidth; ++step) {
          const float* const at = last + (output_start(n) + output) * kHidden + 8 * step;
          const float2 b[2] = {two(at), two(at + 8 * kHidden)};
          multiply(sums, rest, a[step], b);
        }
#pragma unroll
        for (int i = 0; i < 2; ++i)
#pragma unroll
          for (int j = 0; j < 4; ++j) {
            const int64_t anchor = start + lane.row + j / 2 * 8;
            const int number = output + 8 * i + lane.pair + j % 2;
            const float found = sums[i][j] + rest[i][j];
            if (number < outputs && anchor < viewed.count)
              to.of[n][anchor * outputs + number] = n == 0 ? tanhf(found) : found;
          }
      }
    }
    __syncwarp();  // before the next inputs overwrite what others still read
  }
}

// sums += a^T b over the anchors of a tile: 16 numbers of a by 56 of b.
__device__ __forceinline__ void add_products(float (&sums)[kWidth][4], const float* a, int a_row, const float* b,
                                             int b_row) {
  const Lane lane;
  float now[kWidth][4] = {};  // of the tile alone: tensor cores round sums towards 0
  a += lane.quarter * a_row + lane.row, b += lane.quarter * b_row + lane.row;
#pragma unroll 1
  for (int step = 0; step < kTile / 8; ++step, a += 8 * a_row, b += 8 * b_row) {
    const Parts of[4] = {parts_of(a[0]), parts_of(a[8]), parts_of(a[4 * a_row]), parts_of(a[4 * a_row + 8])};
    float2 by[kWidth];
#pragma unroll
    for (int i = 0; i < kWidth; ++i) by[i] = make_float2(b[8 * i], b[8 * i + 4 * b_row]);
    multiply(now, now, of, by);
  }
#pragma unroll
  for (int i = 0; i < kWidth; ++i)
#pragma unroll
    for (int j = 0; j < 4; ++j) sums[i][j] += now[i][j];
}

__device__ void put_products(float* to, const float (&sums)[kWidth][4]) {
  const Lane lane;
#pragma unroll
  for (int i = 0; i < kWidth; ++i)
#pragma unroll
    for (int j = 0; j < 4; ++j) to[(lane.row + j / 2 * 8) * kHidden + 8 * i + lane.pair + j % 2] = sums[i][j];
}
static_assert(kInputs == kHidden);  // of `put_products` both

__global__ void __launch_bounds__(32 * kBackwardWarps)
    backward_kernel(const __grid_constant__ Viewed viewed, const __grid_constant__ Networks networks,
                    const float* alpha, const __grid_constant__ Outputs slopes, float* to_features, float* partial) {
  extern __shared__ __align__(16) float shared[];
  float* const inputs = shared;
  float* const by_output = shared + kAtSlopes;
  float* const columns = shared + kAtColumns;
  float* const alphas = shared + kAtAlpha;
  const float* const first = shared + kAtFirst;
  const float* const last = shared + kAtLast;
  const Lane lane;
  // Warps that are equal modulo 4 share a processor's tensor core: each has its group of anchors and its equal part.
  const int group = int(threadIdx.x) / 32 % kRowGroups, n = int(threadIdx.x) / 32 / kRowGroups;
  const int own_row = group * kGroup + lane.row;
  float* const own = columns + own_row * kColumns + n * kHidden + lane.pair;
  // Rows of weights' gradients in sixteens: outputs 0 to 3, columns 0 to 3; columns 4 to 7, 8 to 10; outputs 4 to 7.
  const int output_group = n == 0 ? group : 4 + group, network = output_group < 1 ? 0 : output_group < 6 ? 1 : 2;
  const int column_group = 8 * n + group;
  const bool has_outputs = n != 1, has_columns = n < 2 && column_group < kColumnGroups;
  float sums[2][kWidth][4] = {};

  clear(shared + kAtFirst, kAtAlpha - kAtFirst);
  load_first(networks, shared + kAtFirst);
  for (int each = 0; each < kNetworks; ++each)
    load_layer(networks.last[each], networks.last_bias[each], networks.outputs[each], networks.hidden,
               shared + kAtLast + output_start(each), 1, kSlopeRow);

  for (int64_t start = int64_t(blockIdx.x) * kTile; start < viewed.count; start += int64_t(gridDim.x) * kTile) {
    load_features<kTile>(viewed, networks.features, start, int(threadIdx.x), int(blockDim.x), inputs);
    __pipeline_commit();
    load_outputs<0>(alpha, networks.outputs[0], start, viewed.count, alphas, kAlphas);
    load_outputs<0>(slopes.of[0], networks.outputs[0], start, viewed.count, by_output, kSlopeRow);
    load_outputs<1>(slopes.of[1], networks.outputs[1], start, viewed.count, by_output + output_start(1), kSlopeRow);
    load_outputs<2>(slopes.of[2], networks.outputs[2], start, viewed.count, by_output + output_start(2), kSlopeRow);
    __pipeline_commit();
    load_directions<kTile>(viewed, networks.features, start, int(threadIdx.x), inputs);
    __pipeline_wait_prior(1);
    __syncthreads();

    {
      float hidden[kWidth][4];
      hidden_layer(networks.hidden, first + n * kHidden * kInputs, inputs + group * kGroup * kInputs, hidden);
#pragma unroll
      for (int i = 0; i < kWidth; ++i)
#pragma unroll
        for (int j = 0; j < 4; j += 2)
          *reinterpret_cast<float2*>(own + j * 4 * kColumns + 8 * i) = make_float2(hidden[i][j], hidden[i][j + 1]);
    }
    __pipeline_wait_prior(0);
    // By what tanh was taken of; a thread has just those numbers that it copied itself.
    for (int at = int(threadIdx.x); at < kTile * kAlphas; at += int(blockDim.x))
      by_output[at / kAlphas * kSlopeRow + at % kAlphas] *= 1.f - alphas[at] * alphas[at];
    __syncthreads();

    if (has_outputs)
      add_products(sums[0], by_output + output_group * kGroup, kSlopeRow, columns + network * kHidden, kColumns);
    float by_hidden[kWidth][4] = {};
#pragma unroll 1
    for (int output = output_start(n); output < output_start(n) + networks.outputs[n]; output += 8) {
      Parts a[4];
      float2 b[kWidth];
      take_rows(a, by_output + own_row * kSlopeRow + output + lane.pair, kSlopeRow);
#pragma unroll
      for (int i = 0; i < kWidth; ++i) b[i] = two(last + (8 * i + lane.row) * kSlopeRow + output + lane.pair);
      multiply(by_hidden, by_hidden, a, b);
    }
    __syncthreads();  // all have taken their products with the hidden layers, which their gradients now replace
#pragma unroll
    for (int i = 0; i < kWidth; ++i)
#pragma unroll
      for (int j = 0; j < 4; j += 2) {
        float2* const place = reinterpret_cast<float2*>(own + j * 4 * kColumns + 8 * i);
        const int number = 8 * i + lane.pair;  // the 1 behind them learns nothing
        *place = make_float2(place->x > 0.f && number != networks.hidden ? by_hidden[i][j] : 0.f,
                             place->y > 0.f && number + 1 != networks.hidden ? by_hidden[i][j + 1] : 0.f);
      }
    __syncthreads();

    if (n == 1) add_products(sums[0], columns + (4 + group) * kGroup, kColumns, inputs, kInputs);
    if (has_columns) add_products(sums[1], columns + column_group * kGroup, kColumns, inputs, kInputs);
    if (n == 2) {
      float by_input[kWidth][4] = {};
#pragma unroll 1
      for (int column = 0; column < kColumns; column += 8) {
        Parts a[4];
        float2 b[kWidth];
        take_rows(a, columns + own_row * kColumns + column + lane.pair, kColumns);
        const float* const from = first + (column + lane.pair) * kInputs + lane.row;
#pragma unroll
        for (int i = 0; i < kWidth; ++i) b[i] = make_float2(from[8 * i], from[8 * i + kInputs]);
        multiply(by_input, by_input, a, b);
      }
#pragma unroll
      for (int i = 0; i < kWidth; ++i)
#pragma unroll
        for (int j = 0; j < 4; ++j) {
          const int64_t anchor = start + own_row + j / 2 * 8;
          const int input = 8 * i + lane.pair + j % 2;
          if (input < networks.features && anchor < viewed.count)
            to_features[anchor * networks.features + input] = by_input[i][j];
        }
    }
    __syncthreads();  // before the next tile overwrites what others still read
  }

  float* const to = partial + int64_t(blockIdx.x) * kSums;
  if (has_outputs) put_products(to + output_group * kGroup * kHidden, sums[0]);
  if (n == 1) put_products(to + kFirstSums + (4 + group) * kGroup * kInputs, sums[0]);
  if (has_columns) put_products(to + kFirstSums + column_group * kGroup * kInputs, sums[1]);
}

// A thread a parameter: the sum of all blocks.
__global__ void __launch_bounds__(kSumThreads)
    sum_kernel(const __grid_constant__ Networks networks, const __grid_constant__ Layout layout, const float* partial,
               int parts, float* to) {
  const int at = int(blockIdx.x) * kSumThreads + int(threadIdx.x), hidden = networks.hidden;
  if (at >= layout.total) return;
  int piece = 0;
  while (piece + 1 < kPieces && at >= layout.start[piece + 1]) ++piece;
  const int n = piece / 4, own = at - layout.start[piece], inputs = networks.features + 4;
  int from = 0, count = 0;
  if (piece % 4 == 0)
    from = kFirstSums + (n * kHidden + own / inputs) * kInputs + own % inputs, count = hidden * inputs;
  else if (piece % 4 == 1)
    from = kFirstSums + (n * kHidden + own) * kInputs + inputs, count = hidden;
  else if (piece % 4 == 2)
    from = (output_start(n) + own / hidden) * kHidden + own % hidden, count = networks.outputs[n] * hidden;
  else
    from = (output_start(n) + own) * kHidden + hidden, count = networks.outputs[n];
  float sum = 0.f;
  if (own < count)
#pragma unroll 12
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
  const int blocks = networks_parts(viewed.count), bytes = kForwardShared * int(sizeof(float));
  if (blocks == 0) return;
  cudaFuncSetAttribute(forward_kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, bytes);
  forward_kernel<<<blocks, 32 * kForwardWarps, bytes, stream>>>(viewed, networks, to);
}

void networks_backward(const Viewed& viewed, const Networks& networks, const float* alpha, const Outputs& slopes,
                       float* to_features, float* partial, float* to_parameters, cudaStream_t stream) {
  const int blocks = networks_parts(viewed.count), bytes = networks_bytes();
  const Layout layout = layout_of(networks);
  if (blocks > 0) {
    cudaFuncSetAttribute(backward_kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, bytes);
    backward_kernel<<<blocks, 32 * kBackwardWarps, bytes, stream>>>(viewed, networks, alpha, slopes, to_features,
                                                                    partial);
  }
  const int wide = (layout.total + kSumThreads - 1) / kSumThreads;
  sum_kernel<<<wide, kSumThreads, 0, stream>>>(networks, layout, partial, blocks, to_parameters);
}

}  // namespace sw_anchors::cuda
