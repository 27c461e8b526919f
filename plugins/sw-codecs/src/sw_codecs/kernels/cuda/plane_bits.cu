// Bits of planes and all their gradients in one pass: a thread a value, whose layers stay in registers on the way
// forward and back.
//
// A gradient of a weight is a sum over all values of input times derivative. A block keeps the inputs of all layers of
// its values in shared memory, and the derivatives of one layer at a time; its threads then take the products in tiles
// of 4 x 4 weights, eight threads a tile, and hold their sums in registers until the block has no more values.
#include "plane_bits.h"

namespace sw_planes::cuda {
namespace {

constexpr int kThreads = 128, kGroups = kThreads / 16;  // 16 tiles make 16 x 16 weights
constexpr int kBlocksPerProcessor = 3;
constexpr int kParametersPadded = (kParameters + 3) / 4 * 4;
// Numbers of shared memory: parameters; neighbours; inputs of the other four layers; derivatives of one layer.
constexpr int kAtNeighbors = kParametersPadded, kAtInputs = kAtNeighbors + kThreads * kNeighbors;
constexpr int kAtDerivatives = kAtInputs + (kResiduals + 1) * kThreads * kHidden;
constexpr int kShared = kAtDerivatives + kThreads * kHidden;
constexpr int kSumsInShared = (kResiduals + 1) * kGroups * kHidden * kHidden;
static_assert(kSumsInShared <= kShared - kAtNeighbors, "the sums of all groups of threads fit behind the parameters");

// Four numbers of a row of 16: swapped among the rows so that eight threads in a row meet all banks.
__device__ __forceinline__ float4* four_of(float* rows, int row, int four) {
  return reinterpret_cast<float4*>(rows) + row * (kHidden / 4) + (four ^ (row >> 1 & 3));
}

__device__ __forceinline__ void put_row(float* rows, int row, const float* from) {
#pragma unroll
  for (int i = 0; i < kHidden / 4; ++i)
    *four_of(rows, row, i) = make_float4(from[4 * i], from[4 * i + 1], from[4 * i + 2], from[4 * i + 3]);
}

// out = bias + weights in, outputs one after the other.
template <int kInputs, int kOutputs>
__device__ __forceinline__ void forward(const float* weights, const float* bias, const float* in, float* out) {
#pragma unroll
  for (int o = 0; o < kOutputs; ++o) {
    float sum = bias[o];
#pragma unroll
    for (int i = 0; i < kInputs; i += 4) {
      const float4 w = *reinterpret_cast<const float4*>(weights + o * kInputs + i);
      sum += w.x * in[i] + w.y * in[i + 1] + w.z * in[i + 2] + w.w * in[i + 3];
    }
    out[o] = sum;
  }
}

// in += transposed weights out.
template <int kInputs, int kOutputs>
__device__ __forceinline__ void backward(const float* weights, const float* out, float* in) {
#pragma unroll
  for (int o = 0; o < kOutputs; ++o)
#pragma unroll
    for (int i = 0; i < kInputs; i += 4) {
      const float4 w = *reinterpret_cast<const float4*>(weights + o * kInputs + i);
      in[i] += w.x * out[o], in[i + 1] += w.y * out[o], in[i + 2] += w.z * out[o], in[i + 3] += w.w * out[o];
    }
}

__device__ __forceinline__ void add_products(float* sums, const float4& d, const float4& a) {
  const float out[4] = {d.x, d.y, d.z, d.w}, in[4] = {a.x, a.y, a.z, a.w};
#pragma unroll
  for (int o = 0; o < 4; ++o)
#pragma unroll
    for (int i = 0; i < 4; ++i) sums[4 * o + i] += out[o] * in[i];
}

__device__ __forceinline__ float component(const float4& v, int i) {
  return i == 0 ? v.x : i == 1 ? v.y : i == 2 ? v.z : v.w;
}

__global__ void __launch_bounds__(kThreads, kBlocksPerProcessor)
    bits_kernel(const __grid_constant__ Planes planes, const float* weights, float* partial) {
  extern __shared__ __align__(16) float shared[];
  const int thread = int(threadIdx.x), orientation = int(blockIdx.y);
  float* const neighbors = shared + kAtNeighbors;
  float* const derivatives = shared + kAtDerivatives;
  for (int i = thread; i < kParameters; i += kThreads) shared[i] = weights[int64_t(orientation) * kParameters + i];

  // Of the tile of weights of this thread: outputs 4 tile_out .., inputs 4 tile_in ..; of values group, group + 8, ...
  const int tile_in = thread & 3, tile_out = thread >> 2 & 3, group = thread >> 4;
  float first_sums[16] = {}, middle_sums[kResiduals][16] = {}, bias_sums[kResiduals + 1] = {};
  float last_sums[4] = {}, last_bias[2] = {}, bits = 0.f;

  int64_t count = 0;
  for (int scale = 0; scale < planes.scales; ++scale) count += planes.count[scale];
  __syncthreads();

  for (int64_t start = int64_t(blockIdx.x) * kThreads; start < count; start += int64_t(gridDim.x) * kThreads) {
    const bool valid = start + thread < count;
    const Place place = place_of(planes, orientation, valid ? start + thread : 0);
    const float* const values = planes.values[place.scale];
    float a[kHidden], b[kHidden];
#pragma unroll
    for (int i = 0; i < kNeighbors; ++i)
      a[i] = valid && has_neighbor(planes, place, i) ? values[neighbor_of(planes, place, i)] : 0.f;
#pragma unroll
    for (int i = 0; i < kNeighbors; i += 4)
      *reinterpret_cast<float4*>(neighbors + thread * kNeighbors + i) = make_float4(a[i], a[i + 1], a[i + 2], a[i + 3]);

    uint32_t alive[2] = {0, 0};  // bits of outputs > 0, of two layers each
    forward<kNeighbors, kHidden>(shared + kFirst, shared + kFirstBias, a, b);
#pragma unroll
    for (int layer = 0; layer <= kResiduals; ++layer) {
#pragma unroll
      for (int i = 0; i < kHidden; ++i) {
        a[i] = fmaxf(layer == 0 ? b[i] : a[i] + b[i], 0.f);
        alive[layer / 2] |= uint32_t(a[i] > 0.f) << (layer % 2 * kHidden + i);
      }
      put_row(shared + kAtInputs + layer * kThreads * kHidden, thread, a);
      const float* const next = shared + kMiddle + layer * kMiddleSize;
      if (layer < kResiduals) forward<kHidden, kHidden>(next, next + kHidden * kHidden, a, b);
    }
    float found[2];
    forward<kHidden, 2>(shared + kLast, shared + kLastBias, a, found);

    Slopes slope{};
    float out[2] = {};
    if (valid) {
      bits += laplace_bits(values[place.at], found[0], found[1], slope);
      out[0] = slope.mean, out[1] = slope.s;
    }
    last_bias[0] += out[0], last_bias[1] += out[1];

    // The last layer: 2 x 4 tiles of 1 x 4 weights, sixteen threads a tile.
    *reinterpret_cast<float2*>(derivatives + 2 * thread) = make_float2(out[0], out[1]);
    __syncthreads();
    {
      const int four = thread & 3, which = thread >> 2 & 1;
      float* const inputs = shared + kAtInputs + kResiduals * kThreads * kHidden;
      for (int row = thread >> 3; row < kThreads; row += kThreads / 8) {
        const float4 in = *four_of(inputs, row, four);
        const float d = derivatives[2 * row + which];
        last_sums[0] += d * in.x, last_sums[1] += d * in.y, last_sums[2] += d * in.z, last_sums[3] += d * in.w;
      }
    }
#pragma unroll
    for (int i = 0; i < kHidden; ++i) a[i] = 0.f;
    backward<kHidden, 2>(shared + kLast, out, a);

#pragma unroll
    for (int layer = kResiduals; layer >= 0; --layer) {
#pragma unroll
      for (int i = 0; i < kHidden; ++i)
        if (!(alive[layer / 2] >> (layer % 2 * kHidden + i) & 1)) a[i] = 0.f;
      __syncthreads();  // all have read the derivatives of the layer behind
      put_row(derivatives, thread, a);
      __syncthreads();
      if (layer > 0) {
        float* const inputs = shared + kAtInputs + (layer - 1) * kThreads * kHidden;
        for (int row = group; row < kThreads; row += kGroups) {
          const float4 d = *four_of(derivatives, row, tile_out);
          add_products(middle_sums[layer > 0 ? layer - 1 : 0], d, *four_of(inputs, row, tile_in));
          bias_sums[layer] += component(d, tile_in);
        }
        // The input itself goes on too: b is what comes back, a what came in.
#pragma unroll
        for (int i = 0; i < kHidden; ++i) b[i] = a[i];
        backward<kHidden, kHidden>(shared + kMiddle + (layer - 1) * kMiddleSize, b, a);
      } else {
        for (int row = group; row < kThreads; row += kGroups) {
          const float4 d = *four_of(derivatives, row, tile_out);
          // The fourth tile has no inputs.
          if (tile_in < kNeighbors / 4)
            add_products(first_sums, d, *reinterpret_cast<const float4*>(neighbors + row * kNeighbors + 4 * tile_in));
          bias_sums[0] += component(d, tile_in);
        }
      }
    }
    if (valid && planes.to[place.scale] != nullptr) {
      float* const to = planes.to[place.scale];
#pragma unroll
      for (int i = 0; i < kNeighbors; ++i) b[i] = 0.f;
      backward<kNeighbors, kHidden>(shared + kFirst, a, b);
      atomicAdd(to + place.at, slope.x);
#pragma unroll
      for (int i = 0; i < kNeighbors; ++i)
        if (has_neighbor(planes, place, i)) atomicAdd(to + neighbor_of(planes, place, i), b[i]);
    }
    __syncthreads();  // before the next values overwrite what others still read
  }

  // Sums of the groups, in their order: those of layer l at [l][group][16][16].
  float* const sums = shared + kAtNeighbors;
#pragma unroll
  for (int layer = 0; layer <= kResiduals; ++layer)
#pragma unroll
    for (int o = 0; o < 4; ++o)
#pragma unroll
      for (int i = 0; i < 4; ++i)
        sums[((layer * kGroups + group) * kHidden + 4 * tile_out + o) * kHidden + 4 * tile_in + i] =
            layer == 0 ? first_sums[4 * o + i] : middle_sums[layer > 0 ? layer - 1 : 0][4 * o + i];
  __syncthreads();
  float* const to = partial + (int64_t(orientation) * gridDim.x + blockIdx.x) * kSums;
  for (int at = thread; at < (kResiduals + 1) * kHidden * kHidden; at += kThreads) {
    const int layer = at / (kHidden * kHidden), o = at / kHidden % kHidden, i = at % kHidden;
    float sum = 0.f;
    for (int each = 0; each < kGroups; ++each) sum += sums[((layer * kGroups + each) * kHidden + o) * kHidden + i];
    if (layer > 0)
      to[kMiddle + (layer - 1) * kMiddleSize + o * kHidden + i] = sum;
    else if (i < kNeighbors)
      to[kFirst + o * kNeighbors + i] = sum;
  }
  __syncthreads();
  // Biases [l][group][16]; the last layer [16 rows][2][16]; its biases and the bits, each [128].
  float* const last = sums + (kResiduals + 1) * kGroups * kHidden;
  float* const rest = last + kThreads / 8 * 2 * kHidden;
#pragma unroll
  for (int layer = 0; layer <= kResiduals; ++layer)
    sums[(layer * kGroups + group) * kHidden + 4 * tile_out + tile_in] = bias_sums[layer];
#pragma unroll
  for (int i = 0; i < 4; ++i)
    last[((thread >> 3) * 2 + (thread >> 2 & 1)) * kHidden + 4 * (thread & 3) + i] = last_sums[i];
  rest[thread] = last_bias[0], rest[kThreads + thread] = last_bias[1], rest[2 * kThreads + thread] = bits;
  __syncthreads();
  if (thread < (kResiduals + 1) * kHidden) {
    const int layer = thread / kHidden, o = thread % kHidden;
    float sum = 0.f;
    for (int each = 0; each < kGroups; ++each) sum += sums[(layer * kGroups + each) * kHidden + o];
    to[layer == 0 ? kFirstBias + o : kMiddle + (layer - 1) * kMiddleSize + kHidden * kHidden + o] = sum;
  } else if (thread < (kResiduals + 1) * kHidden + 2 * kHidden) {
    const int at = thread - (kResiduals + 1) * kHidden;
    float sum = 0.f;
    for (int each = 0; each < kThreads / 8; ++each) sum += last[each * 2 * kHidden + at];
    to[kLast + at] = sum;
  } else if (thread < (kResiduals + 1) * kHidden + 2 * kHidden + 3) {
    const int at = thread - (kResiduals + 1) * kHidden - 2 * kHidden;
    float sum = 0.f;
    for (int each = 0; each < kThreads; ++each) sum += rest[at * kThreads + each];
    to[kLastBias + at] = sum;
  } else if (thread == kThreads - 1) {
    to[kSums - 1] = 0.f;
  }
}

static_assert(kThreads > (kResiduals + 1) * kHidden + 2 * kHidden + 3 && kLastBias + 2 == kParameters);

}  // namespace

int parts_of(const Planes& planes) {
  int64_t count = 0;
  for (int scale = 0; scale < planes.scales; ++scale) count += planes.count[scale];
  int device = 0, processors = 1;
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device);
  const int64_t tiles = (count + kThreads - 1) / kThreads;
  const int64_t at_once = (int64_t(processors) * kBlocksPerProcessor + planes.orientations - 1) / planes.orientations;
  return int(tiles < at_once ? tiles : at_once);
}

void bits(const Planes& planes, const float* weights, float* partial, cudaStream_t stream) {
  const int parts = parts_of(planes);
  if (parts == 0 || planes.orientations == 0) return;
  const int bytes = kShared * int(sizeof(float));
  cudaFuncSetAttribute(bits_kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, bytes);
  bits_kernel<<<dim3(unsigned(parts), unsigned(planes.orientations)), kThreads, bytes, stream>>>(planes, weights,
                                                                                                 partial);
}

}  // namespace sw_planes::cuda
