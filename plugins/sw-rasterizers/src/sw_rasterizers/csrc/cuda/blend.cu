// Forward compositing: a block of 8 warps a tile, a warp a box of 8 x 4 pixels.
//
// The block stages 256 splats of the tile's list at a time in shared memory; the thread that stages a splat also finds
// which boxes it reaches. Each warp then walks only the splats of its own box, as set bits of words.
#include "../blend.h"
#include "kernels.h"
#include "splat.h"

namespace sw::cuda {
namespace {

constexpr int kThreads = kBoxes * kWarp, kWords = kThreads / kWarp;

struct Stage {
  float4 shape[2][kThreads];
  unsigned words[kBoxes][kWords];  // bit i of word w: splat 32 w + i reaches the box
};

// kGeneral: up to kMaxChunk channels from `first_channel` on, and median depth; else the three colours of the splat.
template <bool kGeneral, bool kCount>
__global__ void __launch_bounds__(kThreads)
    blend_kernel(View<float> view, Splats splats, TileLists lists, Image image, int first_channel,
                 Counters* counters, const uint32_t* depth) {
  constexpr int kColors = kGeneral ? kMaxChunk : 3;
  __shared__ Stage stage;
  __shared__ float colors[kThreads][kGeneral ? kMaxChunk : 1];
  const int tile = int(blockIdx.x), tiles_x = view.tiles_x();
  const int x0 = tile % tiles_x * kTile, y0 = tile / tiles_x * kTile;
  const int box = warp_index();
  const int x = x0 + box % kBoxColumns * kBoxWidth + lane_index() % kBoxWidth;
  const int y = y0 + box / kBoxColumns * kBoxHeight + lane_index() / kBoxWidth;
  const bool inside = x < view.width && y < view.height;
  const float centre_x = float(x) + 0.5f, centre_y = float(y) + 0.5f;
  const int begin = lists.start[tile], end = lists.start[tile + 1];
  const int in_chunk = kGeneral ? min(kMaxChunk, image.channels - first_channel) : 3;

  float transmittance = inside ? 1.f : -1.f;  // negative: finished
  float color[kColors] = {};
  int last = 0, median = 0;
  unsigned evaluated = 0, blended = 0;

  int next = begin + int(threadIdx.x) < end ? lists.splat[begin + int(threadIdx.x)] : 0;
  for (int first = begin; first < end; first += kThreads) {
    if (__syncthreads_and(transmittance < 0.f)) break;
    const int slot = next, ahead = first + kThreads + int(threadIdx.x);
    unsigned mask = 0;
    if (first + int(threadIdx.x) < end) {
      const float4 s0 = splats.shape[2 * int64_t(slot)], s1 = splats.shape[2 * int64_t(slot) + 1];
      stage.shape[0][threadIdx.x] = s0, stage.shape[1][threadIdx.x] = s1;
      if constexpr (kGeneral) {
        for (int k = 0; k < kMaxChunk; ++k)
          colors[threadIdx.x][k] =
              k < in_chunk ? splats.channels[int64_t(slot) * image.channels + first_channel + k] : 0.f;
      } else {
        colors[threadIdx.x][0] = splats.tail[slot].x;
      }
      mask = box_mask(s0.x, s0.y, s0.z, s0.w, s1.x, s1.y, x0, y0);
    }
    if (ahead < end) next = lists.splat[ahead];
#pragma unroll
    for (int b = 0; b < kBoxes; ++b) {
      const unsigned word = __ballot_sync(kAllLanes, mask >> b & 1);
      if (lane_index() == b) stage.words[b][warp_index()] = word;
    }
    __syncthreads();

    for (int w = 0; w < kWords; ++w) {
      if (__all_sync(kAllLanes, transmittance < 0.f)) break;
      for (unsigned word = stage.words[box][w]; word != 0; word &= word - 1) {
        const int k = w * kWarp + __ffs(int(word)) - 1;
        const float4 s0 = stage.shape[0][k], s1 = stage.shape[1][k];
        const float power =
            log2_alpha(s0.x - centre_x, s0.y - centre_y, s0.z, s0.w, s1.x, s1.y);
        if constexpr (kCount) evaluated += inside;
        if (power >= float(kLog2AlphaMin)) {
          const float before = transmittance;
          const float weight = composite(fminf(float(kAlphaMax), exp_2(power)), transmittance);
          if (weight > 0.f) last = first - begin + k + 1;
          if constexpr (kGeneral) {
            if (weight > 0.f && before > 0.5f) median = first - begin + k + 1;
#pragma unroll
            for (int channel = 0; channel < kMaxChunk; ++channel) color[channel] += weight * colors[k][channel];
          } else {
            color[0] += weight * s1.z, color[1] += weight * s1.w, color[2] += weight * colors[k][0];
          }
          if constexpr (kCount) blended += weight > 0.f;
        }
      }
    }
  }

  if constexpr (kCount) {
    const unsigned sums[2] = {warp_sum(evaluated), warp_sum(blended)};
    if (lane_index() == 0) {
      atomicAdd(&counters->evaluated, static_cast<unsigned long long>(sums[0]));
      atomicAdd(&counters->blended, static_cast<unsigned long long>(sums[1]));
    }
  }
  if (!inside) return;
  const int64_t size = int64_t(view.width) * view.height, pixel = int64_t(y) * view.width + x;
  transmittance = fabsf(transmittance);
#pragma unroll
  for (int k = 0; k < kColors; ++k) {
    if (k >= in_chunk) break;
    const int channel = first_channel + k;
    float value = color[k];
    if (image.background != nullptr && channel < image.color_channels)
      value += transmittance * image.background[image.background_is_image ? channel * size + pixel : int64_t(channel)];
    image.image[channel * size + pixel] = value;
  }
  if (first_channel > 0) return;  // the first launch writes what all share
  if (image.alpha != nullptr) image.alpha[pixel] = 1.f - transmittance;
  if (image.transmittance != nullptr) image.transmittance[pixel] = transmittance, image.last[pixel] = last;
  if constexpr (kGeneral) {
    if (image.median != nullptr) {
      const int slot = median > 0 ? lists.splat[begin + median - 1] : 0;
      image.median[pixel] = median > 0 ? __uint_as_float(depth[slot]) : 0.f;
      if (image.median_splat != nullptr)
        image.median_splat[pixel] = median > 0 ? __float_as_int(splats.tail[slot].y) : -1;
    }
  }
}

}  // namespace

void blend(const View<float>& view, const Splats& splats, const TileLists& lists, const Image& image,
           bool general, Counters* counters, const uint32_t* depth, cudaStream_t stream) {
  const unsigned tiles = unsigned(view.tiles_x()) * unsigned(view.tiles_y());
  const bool count = counters != nullptr;
  const auto first = general ? (count ? blend_kernel<true, true> : blend_kernel<true, false>)
                             : (count ? blend_kernel<false, true> : blend_kernel<false, false>);
  first<<<tiles, kThreads, 0, stream>>>(view, splats, lists, image, 0, counters, depth);
  for (int channel = kMaxChunk; general && channel < image.channels; channel += kMaxChunk)
    blend_kernel<true, false><<<tiles, kThreads, 0, stream>>>(view, splats, lists, image, channel, nullptr, depth);
}

}  // namespace sw::cuda
