// Backward compositing of surfels: the scheme of blend_backward.cu, kOrdered too. What the maps add to phi and to
// dL/d(1/z) is told at the top of cpu/surfel_blend_backward.cpp.
#include "../blend.h"
#include "groups.h"
#include "surfel_stage.h"
#include "warp_sums.h"

namespace sw::cuda {
namespace {

constexpr int kWarps = 4, kThreads = kWarps * kWarp;
constexpr int kPixels = 2;  // a lane: its pixel in each of the warp's two boxes
using Stage = SurfelStage<kThreads>;

struct Pixel {
  float transmittance, behind;
  int last;
  float gradient[3];
};
struct MapPixel {  // gradients, and what the maps make of them
  int median;
  float depth, normal[3], to_median, first, a0, a1, a2;
};

template <bool kWithMaps>
constexpr int kColumnsOf = kWithMaps ? int(kSurfelColumns) : int(kSurfelPlain);
constexpr int kNoColumn = kSurfelPlain - 1;  // one between the sums is none

// Sums of each warp for each surfel of a stage, where they have one order; a number more than columns, so that rows
// start in different banks.
template <bool kWithMaps>
using OwnSums = float[kWarps][kThreads][kColumnsOf<kWithMaps> + 1];

template <bool kWithMaps, bool kOrdered>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(View<float> view, bool tight, float clamp_limit, Splats splats, TileLists lists, SurfelImage source,
                    ImageGradient gradient, const float* maps_gradient, float* rows, float* pair_sums) {
  constexpr int kColumns = kColumnsOf<kWithMaps>;
  extern __shared__ float own_memory[];
  [[maybe_unused]] auto& own = *reinterpret_cast<OwnSums<kWithMaps>*>(own_memory);
  __shared__ Stage stage;
  __shared__ unsigned block_last;

  const Image& image = source.image;
  const int tile = int(blockIdx.x), tiles_x = view.tiles_x();
  const int begin = lists.start[tile];
  if (begin == lists.start[tile + 1]) return;
  const int x0 = tile % tiles_x * kTile, y0 = tile / tiles_x * kTile;
  const int first_box = warp_index() / kBoxColumns * kPixels * kBoxColumns + warp_index() % kBoxColumns;
  const int x = x0 + first_box % kBoxColumns * kBoxWidth + lane_index() % kBoxWidth;
  const int y = y0 + first_box / kBoxColumns * kBoxHeight + lane_index() / kBoxWidth;
  const int64_t size = int64_t(view.width) * view.height;
  const float centre_x = float(x) + 0.5f, centre_y = float(y) + 0.5f, inverse_far = 1.f / view.far;

  Pixel pixel[kPixels];
  MapPixel map_pixel[kPixels];
#pragma unroll
  for (int p = 0; p < kPixels; ++p) {
    Pixel& state = pixel[p];
    MapPixel& of_maps = map_pixel[p];
    state = {1.f, 0.f, 0, {}};
    of_maps = {};
    const int row = y + p * kBoxHeight;
    if (x >= view.width || row >= view.height) continue;
    const int64_t at = int64_t(row) * view.width + x;
    state.transmittance = image.transmittance[at], state.last = image.last[at];
    float behind = gradient.alpha != nullptr ? -gradient.alpha[at] : 0.f;
#pragma unroll
    for (int k = 0; k < 3; ++k) {
      state.gradient[k] = gradient.image[k * size + at];
      if (image.background != nullptr)
        behind += state.gradient[k] * image.background[image.background_is_image ? k * size + at : int64_t(k)];
    }
    state.behind = state.transmittance * behind;
    if constexpr (kWithMaps) {
      const auto g = [&](int map) { return maps_gradient[map * size + at]; };
      const float first = source.pixels.first[at], distortion = float(kDistortionScale) * g(kMapDistortion);
      of_maps.median = source.pixels.median[at];
      of_maps.depth = g(kMapDepth), of_maps.to_median = g(kMapMedian), of_maps.first = first;
#pragma unroll
      for (int k = 0; k < 3; ++k) of_maps.normal[k] = g(kMapNormal + k);
      of_maps.a0 = distortion * source.pixels.square[at] + g(kMapInverse) * first;
      of_maps.a1 = g(kMapInverse) - 2.f * distortion * source.pixels.sum[at];
      of_maps.a2 = distortion * (1.f - state.transmittance);
    }
  }
  // How many pairs from the front matter to the warp, and to the block.
  const int warp_last = int(warp_max(unsigned(max(pixel[0].last, pixel[1].last))));
  if (threadIdx.x == 0) block_last = 0;
  __syncthreads();
  if (lane_index() == 0) atomicMax(&block_last, unsigned(warp_last));
  __syncthreads();

  const int index = spread_index<kColumns>(lane_index());
  const int column = index == kNoColumn ? -1 : index;
  if constexpr (kOrdered)
    for (int w = 0; w < kWarps; ++w)
      for (int i = 0; i < kColumns; ++i) own[w][threadIdx.x][i] = 0.f;

  for (int stop = int(block_last); stop > 0; stop -= kThreads) {  // list positions [stop - kThreads, stop)
    const int position = stop - 1 - int(threadIdx.x);
    stage.load(splats, position >= 0 ? lists.splat[begin + position] : 0, position >= 0, tight, x0, y0);
    __syncthreads();

    for (int w = 0; w < Stage::kWords; ++w) {
      const unsigned reached[kPixels] = {stage.words[first_box][w], stage.words[first_box + kBoxColumns][w]};
      unsigned word = reached[0] | reached[1];
      const int skipped = stop - warp_last - w * kWarp;  // entries at positions that no pixel of the warp got to
      if (skipped > 0) word = skipped < kWarp ? word & (kAllLanes << skipped) : 0;
      for (; word != 0; word &= word - 1) {
        const int bit = __ffs(int(word)) - 1, k = w * kWarp + bit, at = stop - 1 - k;
        float plane[kPlane];
        stage.read_plane(k, plane);
        const float4 splat = stage.color[k];
        const float color[3] = {splat.y, splat.z, splat.w};
        const float dx = centre_x - plane[kPlaneU];
        float sums[kColumns] = {};
        bool any_touched = false;
#pragma unroll
        for (int p = 0; p < kPixels; ++p) {
          if (!(reached[p] >> bit & 1)) continue;
          Pixel& state = pixel[p];
          const float pixel_y = centre_y + float(p * kBoxHeight), dy = pixel_y - plane[kPlaneV];
          const auto hit = hit_surfel<float>(plane, splat.x, inverse_far, centre_x, pixel_y);
          const bool touched = hit.met && hit.power >= float(kLog2AlphaMin) && state.last > at;
          if (!__any_sync(kAllLanes, touched)) continue;
          any_touched = true;
          const float unclamped = touched ? exp_2(hit.power) : 0.f;
          float phi = color[0] * state.gradient[0] + color[1] * state.gradient[1] + color[2] * state.gradient[2];
          float z = 0.f, zeta = 0.f, delta = 0.f;
          if constexpr (kWithMaps) {
            const MapPixel& g = map_pixel[p];
            z = plane[kPlaneZ] * hit.inverse_w, zeta = plane[kPlaneInverseZ] * hit.w, delta = zeta - g.first;
            phi += g.a0 + delta * (g.a1 + delta * g.a2) + z * g.depth + dot3(plane + kPlaneNormal, g.normal);
          }
          float weight;
          const float alpha_gradient = composite_backward(fminf(float(kAlphaMax), unclamped), phi, state.transmittance,
                                                          state.behind, weight);
          // The clamp at 0.99 stops the gradient, unless it is asked to pass: then the unclamped alpha stands in front.
          const float strength = unclamped <= clamp_limit ? unclamped * alpha_gradient : 0.f;  // -2 dL/drho
          const float on_plane = touched && hit.on_plane ? strength : 0.f, low = strength - on_plane;
          const float slope = -(on_plane * hit.inverse_w * hit.inverse_w);
          // Far from what is touched n1 and n2 may be too large for a product with zero.
          const float n1 = touched ? hit.n1 : 0.f, n2 = touched ? hit.n2 : 0.f;
          const float g1 = slope * n1, g2 = slope * n2;
          float gw = -((g1 * n1 + g2 * n2) * hit.inverse_w);
          if constexpr (kWithMaps) {
            const MapPixel& g = map_pixel[p];
            const float to_depth = weight * g.depth + (touched && g.median == at + 1 ? g.to_median : 0.f);
            const float to_zeta = touched ? weight * (g.a1 + 2.f * delta * g.a2) - z * z * to_depth : 0.f;
            gw += plane[kPlaneInverseZ] * to_zeta;
            sums[kSumZeta] += zeta * to_zeta;
#pragma unroll
            for (int i = 0; i < 3; ++i) sums[kSumNormal + i] += weight * g.normal[i];
          }
          const float gradients[3] = {g1, g2, gw};
#pragma unroll
          for (int i = 0; i < 3; ++i) {
            sums[3 * i] += gradients[i];
            sums[3 * i + 1] += gradients[i] * dx;
            sums[3 * i + 2] += gradients[i] * dy;
          }
          // dL/drho dlow^2/dcentre / 4 = (-strength / 2) (-low).
          sums[kSumLowX] += 0.5f * low * hit.low_x;
          sums[kSumLowY] += 0.5f * low * hit.low_y;
          sums[kSumAlpha] += strength;
#pragma unroll
          for (int channel = 0; channel < 3; ++channel) sums[kSumRed + channel] += weight * state.gradient[channel];
        }
        if (!any_touched) continue;
        const float total = spread_sums<kColumns>(sums);
        if constexpr (kOrdered) {
          if (index >= 0) own[warp_index()][k][index] = total;
        } else {
          if (column >= 0) atomicAdd(rows + int64_t(stage.gaussian[k]) * kColumns + column, total);
        }
      }
    }
    __syncthreads();
    if constexpr (kOrdered) {
      static_assert(kWarps == 4);
      const int k = int(threadIdx.x);
      for (int i = 0; i < kColumns; ++i) {
        if (position >= 0)
          pair_sums[(int64_t(begin) + position) * kColumns + i] =
              (own[0][k][i] + own[1][k][i]) + (own[2][k][i] + own[3][k][i]);
        for (int w = 0; w < kWarps; ++w) own[w][k][i] = 0.f;
      }
    }
  }
}

// Where the sums of a splat go: each has a row of its own.
struct PutSurfel {
  const float2* tail;
  float* rows;
  int columns;
  __device__ __forceinline__ void operator()(int64_t splat, int index, float total) const {
    if (index != kNoColumn) rows[int64_t(__float_as_int(tail[splat].y)) * columns + index] += total;
  }
};

template <bool kWithMaps>
void run(const View<float>& view, bool tight, float clamp_limit, const Splats& splats, const TileLists& lists,
         const SurfelImage& image, const ImageGradient& gradient, const float* maps, float* rows,
         const Ordered& ordered, cudaStream_t stream) {
  constexpr int kColumns = kColumnsOf<kWithMaps>;
  const unsigned tiles = unsigned(view.tiles_x()) * unsigned(view.tiles_y());
  if (ordered.pair_sums == nullptr) {
    backward_kernel<kWithMaps, false><<<tiles, kThreads, 0, stream>>>(view, tight, clamp_limit, splats, lists, image,
                                                                      gradient, maps, rows, nullptr);
    return;
  }
  // Zeros for the pairs that no block gets to.
  cudaMemsetAsync(ordered.pair_sums, 0, size_t(ordered.pairs) * kColumns * sizeof(float), stream);
  constexpr int kBytes = int(sizeof(OwnSums<kWithMaps>));
  cudaFuncSetAttribute(backward_kernel<kWithMaps, true>, cudaFuncAttributeMaxDynamicSharedMemorySize, kBytes);
  backward_kernel<kWithMaps, true><<<tiles, kThreads, kBytes, stream>>>(view, tight, clamp_limit, splats, lists, image,
                                                                        gradient, maps, rows, ordered.pair_sums);
  sum_groups<kColumns>(ordered.splats, ordered.pairs_of_splat, ordered.pair_sums,
                       PutSurfel{splats.tail, rows, kColumns}, stream);
}

}  // namespace

void blend_surfels_backward(const View<float>& view, const Settings& settings, const Splats& splats,
                            const TileLists& lists, const SurfelImage& image, const ImageGradient& gradient,
                            const float* maps, float* rows, const Ordered& ordered, cudaStream_t stream) {
  const float clamp_limit = settings.pass_clamp ? 3e38f : float(kAlphaMax);
  const auto of_kind = maps != nullptr ? run<true> : run<false>;
  of_kind(view, settings.tight, clamp_limit, splats, lists, image, gradient, maps, rows, ordered, stream);
}

}  // namespace sw::cuda
