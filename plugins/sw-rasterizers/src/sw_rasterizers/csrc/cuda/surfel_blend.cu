// Forward compositing of surfels: the scheme of blend.cu, with the ray-plane intersection as the falloff and, if maps
// are asked for, depth, normals and distortion summed along in registers.
#include "../blend.h"
#include "surfel_stage.h"

namespace sw::cuda {
namespace {

constexpr int kThreads = kBoxes * kWarp;
using Stage = SurfelStage<kThreads>;

struct Maps {  // sums of one pixel
  float first = 0.f, sum = 0.f, square = 0.f;  // see SurfelPixels
  float depth = 0.f, normal[3] = {}, distortion = 0.f, median = 0.f;
  int median_position = 0;
};

template <bool kWithMaps, bool kCount>
__global__ void __launch_bounds__(kThreads)
    blend_kernel(View<float> view, bool tight, Splats splats, TileLists lists, SurfelImage target,
                 Counters* counters) {
  __shared__ Stage stage;
  const Image& image = target.image;
  const int tile = int(blockIdx.x), tiles_x = view.tiles_x();
  const int x0 = tile % tiles_x * kTile, y0 = tile / tiles_x * kTile;
  const int box = warp_index();
  const int x = x0 + box % kBoxColumns * kBoxWidth + lane_index() % kBoxWidth;
  const int y = y0 + box / kBoxColumns * kBoxHeight + lane_index() / kBoxWidth;
  const bool inside = x < view.width && y < view.height;
  const float centre_x = float(x) + 0.5f, centre_y = float(y) + 0.5f, inverse_far = 1.f / view.far;
  const int begin = lists.start[tile], end = lists.start[tile + 1];

  float transmittance = inside ? 1.f : -1.f;  // negative: finished
  float color[3] = {};
  Maps maps;
  int last = 0;
  unsigned evaluated = 0, blended = 0;

  for (int first = begin; first < end; first += kThreads) {
    if (__syncthreads_and(transmittance < 0.f)) break;
    const int at = first + int(threadIdx.x);
    stage.load(splats, at < end ? lists.splat[at] : 0, at < end, tight, x0, y0);
    __syncthreads();

    for (int w = 0; w < Stage::kWords; ++w) {
      if (__all_sync(kAllLanes, transmittance < 0.f)) break;
      for (unsigned word = stage.words[box][w]; word != 0; word &= word - 1) {
        const int k = w * kWarp + __ffs(int(word)) - 1;
        float plane[kPlane];
        stage.read_plane(k, plane);
        const float4 splat = stage.color[k];
        const auto hit = hit_surfel<float>(plane, splat.x, inverse_far, centre_x, centre_y);
        if constexpr (kCount) evaluated += inside;
        if (!(hit.met && hit.power >= float(kLog2AlphaMin))) continue;
        const float before = transmittance;
        const float weight = composite(fminf(float(kAlphaMax), exp_2(hit.power)), transmittance);
        if (!(weight > 0.f)) continue;
        last = first - begin + k + 1;
        color[0] += weight * splat.y, color[1] += weight * splat.z, color[2] += weight * splat.w;
        if constexpr (kCount) ++blended;
        if constexpr (kWithMaps) {
          const float z = plane[kPlaneZ] * hit.inverse_w, zeta = plane[kPlaneInverseZ] * hit.w;
          if (before >= 1.f) maps.first = zeta;
          const float delta = zeta - maps.first;
          // weight (m^2 A + M2 - 2 m M1) = weight * scale * sum_j w_j (delta - delta_j)^2
          maps.distortion += weight * (maps.square + delta * ((1.f - before) * delta - 2.f * maps.sum));
          const float moment = weight * delta;
          maps.sum += moment, maps.square += moment * delta;
          maps.depth += weight * z;
#pragma unroll
          for (int i = 0; i < 3; ++i) maps.normal[i] += weight * plane[kPlaneNormal + i];
          if (before > 0.5f) maps.median = z, maps.median_position = last;
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
  for (int k = 0; k < 3; ++k) {
    float value = color[k];
    if (image.background != nullptr)
      value += transmittance * image.background[image.background_is_image ? k * size + pixel : int64_t(k)];
    image.image[k * size + pixel] = value;
  }
  if (image.alpha != nullptr) image.alpha[pixel] = 1.f - transmittance;
  if (image.transmittance != nullptr) image.transmittance[pixel] = transmittance, image.last[pixel] = last;
  if constexpr (kWithMaps) {
    const auto put = [&](int map, float value) { target.maps[map * size + pixel] = value; };
    put(kMapDepth, maps.depth);
    put(kMapInverse, maps.sum + maps.first * (1.f - transmittance));
#pragma unroll
    for (int k = 0; k < 3; ++k) put(kMapNormal + k, maps.normal[k]);
    put(kMapDistortion, float(kDistortionScale) * maps.distortion);
    put(kMapMedian, maps.median);
    if (target.pixels.first != nullptr) {
      target.pixels.first[pixel] = maps.first, target.pixels.sum[pixel] = maps.sum;
      target.pixels.square[pixel] = maps.square, target.pixels.median[pixel] = maps.median_position;
    }
  }
}

}  // namespace

void blend_surfels(const View<float>& view, bool tight, const Splats& splats, const TileLists& lists,
                   const SurfelImage& image, Counters* counters, cudaStream_t stream) {
  const unsigned tiles = unsigned(view.tiles_x()) * unsigned(view.tiles_y());
  const bool maps = image.maps != nullptr, count = counters != nullptr;
  const auto kernel = maps ? (count ? blend_kernel<true, true> : blend_kernel<true, false>)
                           : (count ? blend_kernel<false, true> : blend_kernel<false, false>);
  kernel<<<tiles, kThreads, 0, stream>>>(view, tight, splats, lists, image, counters);
}

}  // namespace sw::cuda
