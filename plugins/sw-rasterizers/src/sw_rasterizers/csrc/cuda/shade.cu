// Colours of the drawn splats: spherical harmonics, given colours, or a row of channels.
//
// A splat whose colour is not finite is dropped: its level becomes one that no pixel passes, its radius 0.
#include "../sh.h"
#include "gather.h"
#include "kernels.h"

namespace sw::cuda {
namespace {

constexpr int kThreads = 128, kWarps = kThreads / kWarp;
constexpr float kNothing = -1e30f;  // log2 of an opacity that draws nothing

__device__ __forceinline__ void drop(const Splats& splats, int slot, int64_t n, int32_t* radii, uint8_t* flags,
                                     Published* published) {
  splats.shape[2 * int64_t(slot) + 1].y = kNothing;
  radii[n] = 0;
  if (flags != nullptr) flags[n] = 0;
  // In the host's memory, where an addition takes long: one for all threads that are here.
  const unsigned here = __activemask();
  if (lane_index() == __ffs(int(here)) - 1)
    atomicAdd(&published->bad_colors, static_cast<unsigned long long>(__popc(here)));
}

template <int kDegree>
__global__ void __launch_bounds__(kThreads)
    shade_kernel(View<float> view, Gaussians<float> g, bool clamp_color, Splats splats, int32_t* radii, uint8_t* flags,
                 const Counters* counters, Published* published) {
  constexpr int kBasis = (kDegree + 1) * (kDegree + 1);
  __shared__ float staged[kDegree > 0 ? kWarps * kWarp * kRestFloats : 1];
  const int slot = int(blockIdx.x * kThreads + threadIdx.x), count = int(counters->splats);
  if (slot - lane_index() >= count) return;
  const bool used = slot < count;
  const int64_t n = used ? __float_as_int(splats.tail[slot].y) : 0;
  float color[3];
  if (g.colors != nullptr) {
    load_row<3>(g.colors, n, color);
  } else {
    const float* rest = nullptr;
    if constexpr (kDegree > 0)
      rest = stage_rest(g, n, used, 3 * (kBasis - 1), staged + warp_index() * kWarp * kRestFloats);
#pragma unroll
    for (int k = 0; k < 3; ++k) color[k] = 0.5f + float(kSH0) * g.sh_dc[n * g.sh_dc_stride + k];
    if constexpr (kDegree > 0) {
      float mean[3], direction[3], basis[kMaxBasis];
      load_row<3>(g.means, n, mean);
      view_direction(view, mean, direction);
      sh_basis(kDegree, direction[0], direction[1], direction[2], basis);
      async_wait();
      __syncwarp();
#pragma unroll
      for (int k = 1; k < kBasis; ++k)
#pragma unroll
        for (int channel = 0; channel < 3; ++channel) color[channel] += basis[k] * rest[3 * (k - 1) + channel];
    }
  }
  if (!used) return;
  const bool finite = finite_probe(color[0]) + finite_probe(color[1]) + finite_probe(color[2]) == 0.f;
  int clamped = 0;
  if (clamp_color && g.colors == nullptr)
#pragma unroll
    for (int k = 0; k < 3; ++k)
      if (color[k] < 0.f) color[k] = 0.f, clamped |= 1 << k;
  reinterpret_cast<float2*>(splats.shape + 2 * int64_t(slot) + 1)[1] = make_float2(color[0], color[1]);
  splats.tail[slot].x = color[2];
  if (!finite)
    drop(splats, slot, n, radii, flags, published);
  else if (clamped != 0 && flags != nullptr)
    flags[n] = uint8_t(kDrawn | clamped);
}

__global__ void __launch_bounds__(kThreads)
    channels_kernel(Gaussians<float> g, Channels channels, Splats splats, SplatWork work, int32_t* radii,
                    uint8_t* flags, const Counters* counters, Published* published) {
  const int slot = int(blockIdx.x * kThreads + threadIdx.x);
  if (slot >= int(counters->splats)) return;
  const float4 shape = splats.shape[2 * int64_t(slot) + 1];
  const float2 tail = splats.tail[slot];
  const int64_t n = __float_as_int(tail.y);
  float* to = splats.channels + int64_t(slot) * channels.total();
  float probe = 0.f;
  const auto put = [&](float value) {
    probe += finite_probe(value);
    *to++ = value;
  };
  if (g.colors != nullptr) {
    for (int k = 0; k < channels.colors; ++k) put(g.colors[n * channels.colors + k]);
  } else {
    put(shape.z), put(shape.w), put(tail.x);
  }
  const float depth = __uint_as_float(work.depth[slot]);
  if (channels.inverse) put(1.f / depth);
  if (channels.accumulated) put(depth);
  for (int k = 0; k < channels.features; ++k) put(g.features[n * channels.features + k]);
  if (!(probe == 0.f) && shape.y != kNothing) drop(splats, slot, n, radii, flags, published);
}

}  // namespace

void shade(const View<float>& view, const Gaussians<float>& g, const Settings& settings, const Splats& splats,
           int32_t* radii, uint8_t* flags, const Counters* counters, Published* published, cudaStream_t stream) {
  const int degree = g.colors != nullptr ? 0 : g.sh_degree;
  const auto kernel = degree == 0   ? shade_kernel<0>
                      : degree == 1 ? shade_kernel<1>
                      : degree == 2 ? shade_kernel<2>
                                    : shade_kernel<3>;
  kernel<<<unsigned(ceil_div(g.count, kThreads)), kThreads, 0, stream>>>(view, g, settings.clamp_color, splats, radii,
                                                                         flags, counters, published);
}

void fill_channels(const Gaussians<float>& g, const Channels& channels, const Splats& splats, const SplatWork& work,
                   int32_t* radii, uint8_t* flags, const Counters* counters, Published* published,
                   cudaStream_t stream) {
  channels_kernel<<<unsigned(ceil_div(g.count, kThreads)), kThreads, 0, stream>>>(g, channels, splats, work, radii,
                                                                                  flags, counters, published);
}

}  // namespace sw::cuda
