// Bits of planes and all their gradients in one pass, on tensor cores: a warp goes with 32 values from their neighbours
// to the sums of gradients, and meets the others of its block only in the end. Needs sm_80.
//
// Tensor cores multiply bfloat16s, so each float is split into some that add up to it: three on the way forward, whose
// products are those of floats; two, which are 16 bits, where sums of gradients are taken. Sums are floats.
//
// Values are taken in two tiles of 16 rows: rows g and g + 8 of tile m are values 4g + 2m and 4g + 2m + 1, and a thread
// (g = lane / 4, t = lane % 4) holds columns 2t, 2t + 1, 2t + 8 and 2t + 9 of both. So value `lane` is a thread's own,
// and what a layer gives lies as the next one takes it.
#include <cuda_bf16.h>

#include "plane_bits.h"

namespace sw_planes::cuda {
namespace {

constexpr unsigned kAllLanes = 0xffffffffu;
constexpr int kWarp = 32, kWarps = 4, kThreads = kWarp * kWarps;
constexpr int kBlocksPerProcessor = 3;
constexpr int kLayers = kResiduals + 1;  // but the last
constexpr int kForward = 3, kBackward = 2;  // parts of a float

// Words of shared memory. A matrix: 32 values by 16 bfloat16s as 4 x 2 blocks of 8 x 8: rows 4g + j of all g, half of
// the columns.
constexpr int kBlock = 32, kMatrix = 8 * kBlock;
constexpr int kAtBackward = kLayers * kForward * kWarp * 4, kAtBiases = kAtBackward + kLayers * kBackward * kWarp * 4;
constexpr int kAtLast = kAtBiases + kResiduals * 2 * kHidden, kAtWarps = kAtLast + 2 * kHidden;
// Of each warp: inputs of each layer, and what is of one layer at a time: derivatives, or what the neighbours lack.
constexpr int kAtDerivatives = kLayers * kBackward * kMatrix, kOfWarp = kAtDerivatives + kBackward * kMatrix;
constexpr int kShared = kAtWarps + kWarps * kOfWarp;
static_assert(kTogether == kWarp && kWarps * kSums <= kShared && kWarp * kNeighbors <= kBackward * kMatrix && kAtWarps % 4 == 0);

// Numbers of a tile: [columns 8 n ..][rows g twice, rows g + 8 twice].
using Tile = float[2][4];
using Parts = uint32_t[4];  // those of a tile in twos: rows g, g + 8, then the other columns
struct Rows {
  uint32_t* tile[2];  // of a matrix: the row of which a thread gives the address when blocks are read or written
};

// c += a b: a [16, 16] as a tile's parts; b [16, 8]: rows 2t .. and 2t + 8 .. of column g; c as half a tile.
__device__ __forceinline__ void multiply(float (&c)[4], const Parts& a, uint32_t b0, uint32_t b1) {
#if __CUDA_ARCH__ >= 800
  asm("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
      "{%0, %1, %2, %3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
#else
  __trap();  // plane_kernels.py offers it from compute capability 8.0 on
#endif
}

// Parts of a tile are its blocks in the order 0, 2, 1, 3: the first word of row lane % 8 of the block lane / 8 in it.
__device__ __forceinline__ int row_of(int lane) { return (lane / 8 % 2 * 2 + lane / 16) * kBlock + lane % 8 * 4; }

// Four blocks of a matrix, of each two numbers of row g, columns 2t and 2t + 1. `row`: of block lane / 8, row lane % 8.
__device__ __forceinline__ void load(Parts& to, const uint32_t* row) {
#if __CUDA_ARCH__ >= 800
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
               : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
               : "r"(unsigned(__cvta_generic_to_shared(row)))
               : "memory");
#endif
}

// The same of transposed blocks.
__device__ __forceinline__ void load_transposed(Parts& to, const uint32_t* row) {
#if __CUDA_ARCH__ >= 800
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
               : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
               : "r"(unsigned(__cvta_generic_to_shared(row)))
               : "memory");
#endif
}

// The inverse of `load`, of a tile.
__device__ __forceinline__ void store(uint32_t* row, const Parts& from) {
#if __CUDA_ARCH__ >= 900
  asm volatile("stmatrix.sync.aligned.m8n8.x4.shared.b16 [%0], {%1, %2, %3, %4};" ::"r"(
                   unsigned(__cvta_generic_to_shared(row))),
               "r"(from[0]), "r"(from[1]), "r"(from[2]), "r"(from[3])
               : "memory");
#else
  const int lane = int(threadIdx.x) % kWarp;
  uint32_t* const word = row - row_of(lane) + lane;
#pragma unroll
  for (int at = 0; at < 4; ++at) word[(at % 2 * 2 + at / 2) * kBlock] = from[at];
#endif
}

// x and y as bfloat16s, x in the low half; leaves what they lack.
__device__ __forceinline__ uint32_t split_off(float& x, float& y) {
  const __nv_bfloat162 both = __floats2bfloat162_rn(x, y);
  const uint32_t bits = reinterpret_cast<const uint32_t&>(both);
  x -= __uint_as_float(bits << 16), y -= __uint_as_float(bits & 0xffff0000u);
  return bits;
}

template <int kParts>
__device__ __forceinline__ void split(const Tile& tile, Parts (&parts)[kParts]) {
#pragma unroll
  for (int at = 0; at < 4; ++at) {
    float x = tile[at / 2][at % 2 * 2], y = tile[at / 2][at % 2 * 2 + 1];
#pragma unroll
    for (int part = 0; part < kParts; ++part) parts[part][at] = split_off(x, y);
  }
}

// c += a b of split numbers, small products first: one that is smaller than what the parts lack is left out.
template <int kParts>
__device__ __forceinline__ void multiply(Tile& c, const Parts (&a)[kParts], const uint4 (&b)[kParts]) {
#pragma unroll
  for (int both = kParts - 1; both >= 0; --both)
#pragma unroll
    for (int part = both; part >= 0; --part) {
      multiply(c[0], a[part], b[both - part].x, b[both - part].y);
      multiply(c[1], a[part], b[both - part].z, b[both - part].w);
    }
}

// Weights [outputs, inputs] of a layer; those of the first go on with its bias, whose input is 1.
__device__ float weight_of(const float* weights, int layer, int out, int in) {
  if (layer > 0) return weights[kMiddle + (layer - 1) * kMiddleSize + out * kHidden + in];
  return in < kNeighbors ? weights[kFirst + out * kNeighbors + in] : in == kNeighbors ? weights[kFirstBias + out] : 0.f;
}

// The weights as what the threads of a warp take of b, forward (inputs by outputs) and backward (outputs by inputs).
template <int kParts>
__device__ __forceinline__ void put_weights(const float* weights, uint32_t* to) {
  constexpr bool kIsForward = kParts == kForward;
  for (int at = int(threadIdx.x); at < kLayers * kWarp * 4; at += kThreads) {
    const int word = at % 4, lane = at / 4 % kWarp, layer = at / (4 * kWarp);
    const int column = word / 2 * 8 + lane / 4, row = word % 2 * 8 + lane % 4 * 2;
    float x = kIsForward ? weight_of(weights, layer, column, row) : weight_of(weights, layer, row, column);
    float y = kIsForward ? weight_of(weights, layer, column, row + 1) : weight_of(weights, layer, row + 1, column);
    if (kIsForward && layer > 0) x += float(row == column), y += float(row + 1 == column);  // the input goes on too
#pragma unroll
    for (int part = 0; part < kParts; ++part)
      to[((layer * kParts + part) * kWarp + lane) * 4 + word] = split_off(x, y);
  }
}

template <int kParts>
__device__ __forceinline__ void get_weights(const uint32_t* from, int layer, int lane, uint4 (&weights)[kParts]) {
#pragma unroll
  for (int part = 0; part < kParts; ++part)
    weights[part] = reinterpret_cast<const uint4*>(from)[(layer * kParts + part) * kWarp + lane];
}

// sums [outputs, inputs] += transposed derivatives [values, outputs] times inputs [values, inputs], of both tiles.
__device__ __forceinline__ void add_products(Tile& sums, const Rows& of_derivatives, const Rows& of_inputs) {
  Parts a[2][kBackward], b[2][kBackward];
#pragma unroll
  for (int m = 0; m < 2; ++m)
#pragma unroll
    for (int part = 0; part < kBackward; ++part) {
      load_transposed(a[m][part], of_derivatives.tile[m] + part * kMatrix);
      load_transposed(b[m][part], of_inputs.tile[m] + part * kMatrix);
    }
  // Tensor cores do not round sums to the nearest: those of many values are taken apart.
  Tile found{};
#pragma unroll
  for (int order = 0; order < 3; ++order)
#pragma unroll
    for (int m = 0; m < 2; ++m)
#pragma unroll
      for (int n = 0; n < 2; ++n)
        multiply(found[n], a[m][order == 0], b[m][order == 1][2 * n], b[m][order == 1][2 * n + 1]);
#pragma unroll
  for (int n = 0; n < 2; ++n)
#pragma unroll
    for (int i = 0; i < 4; ++i) sums[n][i] += found[n][i];
}

// Sum over the threads of a warp that have the same t; over all with `kAll`.
template <bool kAll = false>
__device__ __forceinline__ float sum_of(float x) {
#pragma unroll
  for (int step = kAll ? 1 : 4; step < kWarp; step *= 2) x += __shfl_xor_sync(kAllLanes, x, step);
  return x;
}

// Add derivatives by a value's neighbours, and by itself, to planes. Values of a warp follow each other: for each line,
// their sums are taken first, those within the places of the 32 values and those beyond, 32 places further on or back.
// kOrdered: they stay in `parts`, in which the warp is number `group`.
template <bool kOrdered>
__device__ __forceinline__ void add_to_plane(const Planes& planes, const Place& place, int orientation, int group,
                                             unsigned has, const float* by, float by_itself, int lane) {
#pragma unroll
  for (int line = 0; line < kLines; ++line) {
    float within = line == kAbove ? by_itself : 0.f, beyond = 0.f;
#pragma unroll
    for (int i = 0; i < kNeighbors; ++i)
      if (down_of(i) == line - kAbove) {
        const int from = lane - right_of(i);  // the value whose neighbour is at this thread's place
        const float x = __shfl_sync(kAllLanes, has >> i & 1 ? by[i] : 0.f, from & (kWarp - 1));
        (from == (from & (kWarp - 1)) ? within : beyond) += x;
      }
    if constexpr (kOrdered) {
      const int64_t of_group = int64_t(orientation) * groups_of(planes, place.scale) + group;
      float* const own = planes.parts[place.scale] + (of_group * kLines + line) * 2 * kTogether + lane;
      own[0] = within, own[kTogether] = beyond;
    } else {
      float* const to = planes.to[place.scale] + place.at + int64_t(line - kAbove) * planes.width[place.scale];
      // What would go beyond the planes is 0.
      if (within != 0.f) atomicAdd(to, within);
      if (beyond != 0.f) atomicAdd(lane < kWarp / 2 ? to + kWarp : to - kWarp, beyond);
    }
  }
}

// Sums of `parts` of one scale: a thread a value, blockIdx.y the orientation. See `add_to_plane` for what lies where.
__global__ void __launch_bounds__(kThreads) gather_kernel(const __grid_constant__ Planes planes, int scale) {
  const int64_t at = int64_t(blockIdx.x) * kThreads + threadIdx.x, count = planes.count[scale];
  if (at >= count) return;
  const int64_t orientation = blockIdx.y, end = int64_t(groups_of(planes, scale)) * kTogether;
  const float* const parts = planes.parts[scale] + orientation * part_sums(planes, scale);
  const auto part = [&](int64_t place, int line, int which) {
    return place < 0 || place >= end
               ? 0.f
               : parts[((place / kTogether * kLines + line) * 2 + which) * kTogether + place % kTogether];
  };
  float sum = 0.f;
  for (int line = 0; line < kLines; ++line) {
    const int64_t place = at + int64_t(kAbove - line) * planes.width[scale];
    sum += part(place, line, 0) + part(place % kTogether < kTogether / 2 ? place - kTogether : place + kTogether, line, 1);
  }
  planes.to[scale][orientation * count + at] = sum;
}

template <bool kOrdered>
__global__ void __launch_bounds__(kThreads, kBlocksPerProcessor)
    bits_kernel(const __grid_constant__ Planes planes, const float* weights, float* partial) {
  extern __shared__ __align__(16) uint32_t shared[];
  const int thread = int(threadIdx.x), lane = thread % kWarp, orientation = int(blockIdx.y);
  const int g = lane / 4, t = lane % 4;
  weights += int64_t(orientation) * kParameters;
  put_weights<kForward>(weights, shared);
  put_weights<kBackward>(weights, shared + kAtBackward);
  float* const biases = reinterpret_cast<float*>(shared + kAtBiases);  // [layer][columns' half][t][twice two]
  float* const last = reinterpret_cast<float*>(shared + kAtLast);
  for (int i = thread; i < kResiduals * 2 * kHidden; i += kThreads)
    biases[i] = weights[kMiddle + i / (2 * kHidden) * kMiddleSize + kHidden * kHidden + i / kHidden % 2 * 8 +
                        i / 4 % 4 * 2 + i % 2];
  for (int i = thread; i < 2 * kHidden; i += kThreads) last[i] = weights[kLast + i];
  const float last_biases[2] = {weights[kLastBias], weights[kLastBias + 1]};

  // Neighbours come from each value's own thread: rows of their blocks are swapped, or else four would meet in a bank.
  uint32_t* const of_warp = shared + kAtWarps + thread / kWarp * kOfWarp;
  const int row = row_of(lane), swapped = row ^ lane / 8 % 2 * 8;
  const Rows neighbors{{of_warp + swapped, of_warp + 4 * kBlock + (swapped ^ 16)}};
  const Rows inputs{{of_warp + row, of_warp + 4 * kBlock + row}};
  const Rows derivatives{{inputs.tile[0] + kAtDerivatives, inputs.tile[1] + kAtDerivatives}};
  const Rows transposed{{of_warp + kAtDerivatives + lane * 4, of_warp + kAtDerivatives + 4 * kBlock + lane * 4}};

  Tile first_sums{}, middle_sums[kResiduals]{};
  float bias_sums[kResiduals][4]{}, last_sums[2][4]{}, last_bias_sums[2]{}, bits = 0.f;

  int groups = 0;
  for (int scale = 0; scale < planes.scales; ++scale) groups += groups_of(planes, scale);
  __syncthreads();

  for (int group = int(blockIdx.x) * kWarps + thread / kWarp; group < groups; group += int(gridDim.x) * kWarps) {
    int scale = 0, in_scale = group;
    while (in_scale >= groups_of(planes, scale)) in_scale -= groups_of(planes, scale), ++scale;
    const int index = in_scale * kWarp + lane;
    const bool valid = index < planes.count[scale];
    const Place place = place_of(planes, orientation, scale, index);
    const float* const values = planes.values[scale];
    const float value = valid ? values[place.at] : 0.f;
    const unsigned has = valid ? neighbors_of(planes, place) : 0;
    float around[kHidden] = {};
#pragma unroll
    for (int i = 0; i < kNeighbors; ++i) around[i] = has >> i & 1 ? values[neighbor_of(planes, place, i)] : 0.f;
    around[kNeighbors] = 1.f;

    __syncwarp();  // all have read what they need of the values before
#pragma unroll
    for (int part = 0; part < kForward; ++part) {
      uint32_t* const to = of_warp + (part < kBackward ? part * kMatrix : kAtDerivatives);
#pragma unroll
      for (int half = 0; half < 2; ++half) {
        uint32_t words[4];
#pragma unroll
        for (int i = 0; i < 4; ++i) words[i] = split_off(around[half * 8 + 2 * i], around[half * 8 + 2 * i + 1]);
        *reinterpret_cast<uint4*>(to + (2 * t + half) * kBlock + (g ^ 2 * t) * 4) =
            make_uint4(words[0], words[1], words[2], words[3]);
      }
    }
    __syncwarp();

    Tile tiles[2]{};
    {
      uint4 b[kForward];
      get_weights(shared, 0, lane, b);
#pragma unroll
      for (int m = 0; m < 2; ++m) {
        Parts a[kForward];
#pragma unroll
        for (int part = 0; part < kForward; ++part)
          load(a[part], neighbors.tile[m] + (part < kBackward ? part * kMatrix : kAtDerivatives));
        multiply(tiles[m], a, b);
#pragma unroll
        for (int at = 0; at < 8; ++at) tiles[m][at / 4][at % 4] = fmaxf(tiles[m][at / 4][at % 4], 0.f);
      }
    }
#pragma unroll
    for (int layer = 1; layer < kLayers; ++layer) {
      uint4 b[kForward];
      get_weights(shared, layer, lane, b);
      float4 bias[2];
#pragma unroll
      for (int n = 0; n < 2; ++n) bias[n] = reinterpret_cast<const float4*>(biases)[((layer - 1) * 2 + n) * 4 + t];
#pragma unroll
      for (int m = 0; m < 2; ++m) {
        Parts a[kForward];
        split(tiles[m], a);
#pragma unroll
        for (int part = 0; part < kBackward; ++part)
          store(inputs.tile[m] + (layer * kBackward + part) * kMatrix, a[part]);
#pragma unroll
        for (int n = 0; n < 2; ++n)
          tiles[m][n][0] = tiles[m][n][2] = bias[n].x, tiles[m][n][1] = tiles[m][n][3] = bias[n].y;
        multiply(tiles[m], a, b);
#pragma unroll
        for (int at = 0; at < 8; ++at) tiles[m][at / 4][at % 4] = fmaxf(tiles[m][at / 4][at % 4], 0.f);
      }
    }

    // The last layer, in floats: sums over a thread's columns of its four rows, then over four threads, each of which
    // keeps the row of its value.
    float last_weights[2][4];  // of the thread's columns
#pragma unroll
    for (int i = 0; i < 8; ++i) last_weights[i / 4][i % 4] = last[i / 4 * kHidden + i % 4 / 2 * 8 + 2 * t + i % 2];
    float found[2];
#pragma unroll
    for (int which = 0; which < 2; ++which) {
      float sums[4] = {};
#pragma unroll
      for (int j = 0; j < 4; ++j)
#pragma unroll
        for (int i = 0; i < 4; ++i) sums[j] += last_weights[which][i] * tiles[j / 2][i / 2][j % 2 * 2 + i % 2];
#pragma unroll
      for (int j = 0; j < 2; ++j) {
        const float other = __shfl_xor_sync(kAllLanes, t < 2 ? sums[j + 2] : sums[j], 2);
        sums[j] = (t < 2 ? sums[j] : sums[j + 2]) + other;
      }
      const float other = __shfl_xor_sync(kAllLanes, t % 2 == 0 ? sums[1] : sums[0], 1);
      found[which] = (t % 2 == 0 ? sums[0] : sums[1]) + other + last_biases[which];
    }

    Slopes slope{};
    if (valid) bits += laplace_bits(value, found[0], found[1], slope);
    last_bias_sums[0] += slope.mean, last_bias_sums[1] += slope.s;

    // From here on, `tiles` are derivatives.
#pragma unroll
    for (int j = 0; j < 4; ++j) {
      const float by_mean = __shfl_sync(kAllLanes, slope.mean, lane - t + j);
      const float by_s = __shfl_sync(kAllLanes, slope.s, lane - t + j);
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        float& x = tiles[j / 2][i / 2][j % 2 * 2 + i % 2];
        last_sums[0][i] += by_mean * x, last_sums[1][i] += by_s * x;
        x = x > 0.f ? by_mean * last_weights[0][i] + by_s * last_weights[1][i] : 0.f;
      }
    }
#pragma unroll
    for (int layer = kResiduals; layer >= 0; --layer) {
      Parts a[2][kBackward];
      split(tiles[0], a[0]), split(tiles[1], a[1]);
      __syncwarp();  // all have read the derivatives of the layer behind
#pragma unroll
      for (int m = 0; m < 2; ++m)
#pragma unroll
        for (int part = 0; part < kBackward; ++part) store(derivatives.tile[m] + part * kMatrix, a[m][part]);
      __syncwarp();
      uint4 b[kBackward];
      get_weights(shared + kAtBackward, layer, lane, b);
      if (layer > 0) {
        const int at_layer = layer * kBackward * kMatrix;
        const Rows of_layer{{inputs.tile[0] + at_layer, inputs.tile[1] + at_layer}};
        add_products(middle_sums[layer > 0 ? layer - 1 : 0], transposed, of_layer);
#pragma unroll
        for (int i = 0; i < 4; ++i)
          bias_sums[layer > 0 ? layer - 1 : 0][i] += (tiles[0][i / 2][i % 2] + tiles[0][i / 2][i % 2 + 2]) +
                                                     (tiles[1][i / 2][i % 2] + tiles[1][i / 2][i % 2 + 2]);
#pragma unroll
        for (int m = 0; m < 2; ++m) {
          multiply(tiles[m], a[m], b);  // what is there goes on too, as the input itself does
          Parts from;  // inputs, which are not negative
          load(from, of_layer.tile[m]);
#pragma unroll
          for (int at = 0; at < 4; ++at) {
            if ((from[at] & 0xffffu) == 0) tiles[m][at / 2][at % 2 * 2] = 0.f;
            if (from[at] >> 16 == 0) tiles[m][at / 2][at % 2 * 2 + 1] = 0.f;
          }
        }
      } else {
        add_products(first_sums, transposed, neighbors);
        if (planes.to[scale] == nullptr) continue;
        __syncwarp();
        float* const by = reinterpret_cast<float*>(of_warp + kAtDerivatives);
#pragma unroll
        for (int m = 0; m < 2; ++m) {
          Tile c{};
          multiply(c, a[m], b);
#pragma unroll
          for (int at = 0; at < 4; ++at)
            if (at / 2 == 0 || t < 2)
              *reinterpret_cast<float2*>(by + (4 * g + 2 * m + at % 2) * kNeighbors + at / 2 * 8 + 2 * t) =
                  make_float2(c[at / 2][at % 2 * 2], c[at / 2][at % 2 * 2 + 1]);
        }
        __syncwarp();
#pragma unroll
        for (int i = 0; i < kNeighbors; i += 4) {
          const float4 four = *reinterpret_cast<const float4*>(by + lane * kNeighbors + i);
          around[i] = four.x, around[i + 1] = four.y, around[i + 2] = four.z, around[i + 3] = four.w;
        }
        add_to_plane<kOrdered>(planes, place, orientation, in_scale, has, around, slope.x, lane);
      }
    }
  }

  // Sums of each warp, as `partial` has them, then those of the block.
  __syncthreads();
  float* const sums = reinterpret_cast<float*>(shared) + thread / kWarp * kSums;
#pragma unroll
  for (int at = 0; at < 8; ++at) {
    const int out = g + at % 4 / 2 * 8, in = at / 4 * 8 + 2 * t + at % 2;
    if (in <= kNeighbors)
      sums[in < kNeighbors ? kFirst + out * kNeighbors + in : kFirstBias + out] = first_sums[at / 4][at % 4];
#pragma unroll
    for (int layer = 0; layer < kResiduals; ++layer)
      sums[kMiddle + layer * kMiddleSize + out * kHidden + in] = middle_sums[layer][at / 4][at % 4];
  }
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const int column = i / 2 * 8 + 2 * t + i % 2;
#pragma unroll
    for (int layer = 0; layer < kResiduals; ++layer) {
      const float sum = sum_of(bias_sums[layer][i]);
      if (g == 0) sums[kMiddle + layer * kMiddleSize + kHidden * kHidden + column] = sum;
    }
#pragma unroll
    for (int which = 0; which < 2; ++which) {
      const float sum = sum_of(last_sums[which][i]);
      if (g == 0) sums[kLast + which * kHidden + column] = sum;
    }
  }
  const float rest[3] = {sum_of<true>(last_bias_sums[0]), sum_of<true>(last_bias_sums[1]), sum_of<true>(bits)};
  if (lane == 0)
    sums[kLastBias] = rest[0], sums[kLastBias + 1] = rest[1], sums[kParameters] = rest[2], sums[kParameters + 1] = 0.f;
  __syncthreads();
  float* const to = partial + (int64_t(orientation) * gridDim.x + blockIdx.x) * kSums;
  for (int at = thread; at < kSums; at += kThreads) {
    float sum = 0.f;
    for (int warp = 0; warp < kWarps; ++warp) sum += reinterpret_cast<const float*>(shared)[warp * kSums + at];
    to[at] = sum;
  }
}

static_assert(kLastBias + 2 == kParameters && kParameters + 2 == kSums);

}  // namespace

int parts_of(const Planes& planes) {
  int64_t groups = 0;
  for (int scale = 0; scale < planes.scales; ++scale) groups += groups_of(planes, scale);
  int device = 0, processors = 1;
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device);
  const int64_t full = (groups + kWarps - 1) / kWarps;
  const int64_t at_once = (int64_t(processors) * kBlocksPerProcessor + planes.orientations - 1) / planes.orientations;
  return int(full < at_once ? full : at_once);
}

void bits(const Planes& planes, const float* weights, float* partial, cudaStream_t stream) {
  const int parts = parts_of(planes);
  if (parts == 0 || planes.orientations == 0) return;
  bool ordered = false;
  for (int scale = 0; scale < planes.scales; ++scale) ordered = ordered || planes.parts[scale] != nullptr;
  const auto kernel = ordered ? bits_kernel<true> : bits_kernel<false>;
  const int bytes = kShared * int(sizeof(uint32_t));
  const unsigned orientations = unsigned(planes.orientations);
  cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, bytes);
  kernel<<<dim3(unsigned(parts), orientations), kThreads, bytes, stream>>>(planes, weights, partial);
  for (int scale = 0; scale < planes.scales; ++scale)
    if (planes.parts[scale] != nullptr && planes.count[scale] > 0) {
      const unsigned blocks = unsigned((planes.count[scale] + kThreads - 1) / kThreads);
      gather_kernel<<<dim3(blocks, orientations), kThreads, 0, stream>>>(planes, scale);
    }
}

}  // namespace sw_planes::cuda
