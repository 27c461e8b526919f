// Forward compositing for inference: a warp a box of 8 x 4 pixels, as in blend.cu, but four pixels a lane.
//
// Compositing is associative: a run of splats acts on what lies in front of it by its own colour and transmittance
// alone. So the four lanes of a group share one column of four pixels, each takes another quarter of the box's list,
// and the four results are joined after every kRun splats. What a lane loads then serves four pixels.
// Approximations: no pixel stops by itself, only a warp whose pixels are all finished (blend.cu leaves out the splat
// that would bring the transmittance below 1e-4, here it is drawn); log2 alpha is a polynomial about the tile's middle.
#pragma once

#include "../blend.h"
#include "kernels.h"
#include "splat.h"

namespace sw::cuda {

constexpr int kFastThreads = kBoxes * kWarp;
constexpr int kQuarters = 4, kColumn = kBoxHeight;  // lanes of a group; pixels of a lane
constexpr int kRun = 64;                            // splats between joins
constexpr int kStep = 2 * kQuarters;                // splats of a run come in such multiples: two a lane
constexpr float kFar = -30000.f;                    // log2 of an alpha that is not drawn; a half holds it
static_assert(kWarp == kQuarters * kBoxWidth && kRun % kStep == 0);

// log2 alpha = 1, x, y, x^2, xy, y^2 times these; x and y from the middle of the tile.
struct Polynomial {
  float k[6];
};

__device__ __forceinline__ Polynomial polynomial(float4 s0, float4 s1, float middle_x, float middle_y) {
  const float x = middle_x - s0.x, y = middle_y - s0.y, a = s0.z, b = s0.w, c = s1.x;
  const float lean = a * x + b * y;
  return {{fmaxf(s1.y + (x * lean + c * y * y), kFar), lean + a * x, 2.f * c * y + b * x, a, b, c}};
}

// What a run of splats does to a lane's pixels.
struct Segment {
  float transmittance[kColumn], color[kColumn][3];

  __device__ __forceinline__ void add(int j, float power, float red, float green, float blue) {
    const float alpha = power >= float(kLog2AlphaMin) ? fminf(float(kAlphaMax), exp_2(power)) : 0.f;  // NaN: 0
    const float weight = alpha * transmittance[j];
    transmittance[j] -= weight;
    color[j][0] += weight * red, color[j][1] += weight * green, color[j][2] += weight * blue;
  }
};

// Joins the quarters of a group: `all` gets the transmittance of the whole, and its colours a lane's own share.
__device__ __forceinline__ void join(Segment& all, const Segment& part) {
  const int quarter = lane_index() % kQuarters;
#pragma unroll
  for (int j = 0; j < kColumn; ++j) {
    float through = part.transmittance[j];
    float other = __shfl_up_sync(kAllLanes, through, 1, kQuarters);
    if (quarter >= 1) through *= other;
    other = __shfl_up_sync(kAllLanes, through, 2, kQuarters);
    if (quarter >= 2) through *= other;
    other = __shfl_up_sync(kAllLanes, through, 1, kQuarters);
    const float before = quarter >= 1 ? all.transmittance[j] * other : all.transmittance[j];
#pragma unroll
    for (int k = 0; k < 3; ++k) all.color[j][k] += before * part.color[j][k];
    all.transmittance[j] *= __shfl_sync(kAllLanes, through, kQuarters - 1, kQuarters);
  }
}

__device__ __forceinline__ void put(float* image, int64_t at, float value) { image[at] = value; }
__device__ __forceinline__ void put(uint8_t* image, int64_t at, float value) {
  image[at] = uint8_t(__float2int_rn(255.f * __saturatef(value)));
}

// Method: Record, what a splat is in shared memory, with `set`; and what a lane knows of its column, with
// `walk(records, list, steps, segment)`: composites kStep * steps entries, a quarter each. Entries are offsets in bytes.
template <class Method, class Value>
__global__ void __launch_bounds__(kFastThreads, 4)  // a few spilled bytes cost less than a quarter fewer warps
    fast_kernel(View<float> view, Splats splats, TileLists lists, Image image, Value* out) {
  using Record = typename Method::Record;
  constexpr int kWords = kFastThreads / kWarp;
  static_assert(sizeof(Record) * kFastThreads <= 0xffff);
  __shared__ Record records[kFastThreads + 1];  // the last one draws nothing
  __shared__ __align__(16) uint16_t entries[kBoxes][kFastThreads + kStep];
  __shared__ unsigned words[kBoxes][kWords];  // bit i of word w: splat 32 w + i reaches the box
  const int tile = int(blockIdx.y * gridDim.x + blockIdx.x), x0 = int(blockIdx.x) * kTile, y0 = int(blockIdx.y) * kTile;
  const float middle_x = float(x0) + 0.5f * kTile, middle_y = float(y0) + 0.5f * kTile;
  const int box = warp_index(), quarter = lane_index() % kQuarters;
  const int x = x0 + box % kBoxColumns * kBoxWidth + lane_index() / kQuarters;
  const int y = y0 + box / kBoxColumns * kBoxHeight;
  const Method method(float(x) + 0.5f - middle_x, float(y) + 0.5f - middle_y);
  const int begin = lists.start[tile], end = lists.start[tile + 1];
  uint16_t* const list = entries[box];
  const unsigned bit = 1u << lane_index(), below = bit - 1;

  Segment all = {};
#pragma unroll
  for (int j = 0; j < kColumn; ++j) all.transmittance[j] = x < view.width && y + j < view.height ? 1.f : 0.f;
  const auto finished = [&] {
    float most = 0.f;
#pragma unroll
    for (int j = 0; j < kColumn; ++j) most = fmaxf(most, all.transmittance[j]);
    return __all_sync(kAllLanes, most < float(kTransmittanceMin));
  };
  if (threadIdx.x == 0) records[kFastThreads].set({{kFar, 0.f, 0.f, 0.f, 0.f, 0.f}}, 0.f, 0.f, 0.f);

  bool done = finished();
  int next = begin + int(threadIdx.x) < end ? lists.splat[begin + int(threadIdx.x)] : 0;
  for (int first = begin; first < end; first += kFastThreads) {
    if (__syncthreads_and(done)) break;
    const int slot = next, ahead = first + kFastThreads + int(threadIdx.x);
    unsigned mask = 0;
    if (first + int(threadIdx.x) < end) {
      const float4 s0 = splats.shape[2 * int64_t(slot)], s1 = splats.shape[2 * int64_t(slot) + 1];
      records[threadIdx.x].set(polynomial(s0, s1, middle_x, middle_y), s1.z, s1.w, splats.tail[slot].x);
      mask = box_mask(s0.x, s0.y, s0.z, s0.w, s1.x, s1.y, x0, y0);
    }
    if (ahead < end) next = lists.splat[ahead];
#pragma unroll
    for (int b = 0; b < kBoxes; ++b) {
      const unsigned word = __ballot_sync(kAllLanes, mask >> b & 1);
      if (lane_index() == b) words[b][warp_index()] = word;
    }
    __syncthreads();
    if (done) continue;

    unsigned length = 0;
    unsigned mine = unsigned(lane_index() * sizeof(Record));
#pragma unroll
    for (int w = 0; w < kWords; ++w, mine += unsigned(kWarp * sizeof(Record))) {
      const unsigned word = words[box][w];
      if (word & bit) list[length + unsigned(__popc(word & below))] = uint16_t(mine);
      length += unsigned(__popc(word));
    }
    if (lane_index() < kStep) list[length + unsigned(lane_index())] = uint16_t(kFastThreads * sizeof(Record));
    __syncwarp();
    for (unsigned from = 0; from < length && !done; from += kRun) {
      Segment part = {};
#pragma unroll
      for (int j = 0; j < kColumn; ++j) part.transmittance[j] = 1.f;
      method.walk(records, list + from, int(min(unsigned(kRun), length - from) + kStep - 1) / kStep, part);
      join(all, part);
      done = finished();
    }
  }

  // Each lane of a group ends up with the sums of another pixel of the column, and writes it.
  const bool odd = quarter & 1, high = quarter & 2;
  float color[3];
#pragma unroll
  for (int k = 0; k < 3; ++k) {
    const auto c = [&](int j) { return all.color[j][k]; };
    const float first = (odd ? c(1) : c(0)) + __shfl_xor_sync(kAllLanes, odd ? c(0) : c(1), 1);
    const float second = (odd ? c(3) : c(2)) + __shfl_xor_sync(kAllLanes, odd ? c(2) : c(3), 1);
    color[k] = (high ? second : first) + __shfl_xor_sync(kAllLanes, high ? first : second, 2);
  }
  const float* t = all.transmittance;
  const float transmittance = high ? (odd ? t[3] : t[2]) : (odd ? t[1] : t[0]);
  if (x >= view.width || y + quarter >= view.height) return;
  const int64_t size = int64_t(view.width) * view.height, pixel = int64_t(y + quarter) * view.width + x;
#pragma unroll
  for (int k = 0; k < 3; ++k) {
    float value = color[k];
    if (image.background != nullptr)
      value += transmittance * image.background[image.background_is_image ? k * size + pixel : int64_t(k)];
    put(out, k * size + pixel, value);
  }
  if (image.alpha != nullptr) image.alpha[pixel] = 1.f - transmittance;
}

template <class Method>
void blend_fast(const View<float>& view, const Splats& splats, const TileLists& lists, const Image& image,
                uint8_t* bytes, cudaStream_t stream) {
  const dim3 tiles(unsigned(view.tiles_x()), unsigned(view.tiles_y()));
  if (bytes != nullptr)
    fast_kernel<Method><<<tiles, kFastThreads, 0, stream>>>(view, splats, lists, image, bytes);
  else
    fast_kernel<Method><<<tiles, kFastThreads, 0, stream>>>(view, splats, lists, image, image.image);
}

}  // namespace sw::cuda
