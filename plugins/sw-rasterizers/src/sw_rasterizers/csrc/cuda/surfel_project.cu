// Projection of surfels: as project.cu, with a plane instead of a conic.
#include "gather.h"
#include "numbering.h"
#include "splat.h"
#include "surfel_kernels.h"

namespace sw::cuda {
namespace {

struct Screened {  // a projected surfel, and whether it is drawn
  SurfelProjection<float> p;
  float opacity;
  int32_t radius;  // 0: not seen
  bool valid;      // all values are finite
};

__device__ __forceinline__ Screened screen(const View<float>& view, const Gaussians<float>& g, float scale_modifier,
                                           int64_t n) {
  Screened s;
  SurfelGeometry<float> in;
  load_row<3>(g.means, n, in.mean);
  load_row<2>(g.scales, n, in.scale);
  load_row<4>(g.quats, n, in.quat);
  s.opacity = g.opacities != nullptr ? g.opacities[n] : 1.f;
  float probe = finite_probe(s.opacity);
#pragma unroll
  for (int k = 0; k < 3; ++k) probe += finite_probe(in.mean[k]);
#pragma unroll
  for (int k = 0; k < 2; ++k) probe += finite_probe(in.scale[k]);
#pragma unroll
  for (int k = 0; k < 4; ++k) probe += finite_probe(in.quat[k]);
  s.valid = probe == 0.f;
  SurfelProjection<float>& p = s.p;
  project_surfel(view, scale_modifier, in, p);
  float derived = finite_probe(p.u0) + finite_probe(p.v0) + finite_probe(p.center_x) + finite_probe(p.center_y) +
                  finite_probe(p.extent_x) + finite_probe(p.extent_y);
  // No ray meets an edge-on plane, or one with a scale of zero: its coefficients are infinite. With room for the
  // pixels they are multiplied by.
  for (const float x : {p.a, p.b, p.c, p.d, p.e, p.f}) derived += finite_probe(x * 1e6f);
  const bool alive = s.valid && derived == 0.f && p.t[2] > view.near && p.t[2] < view.far && p.denominator != 0.f &&
                     p.facing != 0.f && s.opacity >= 0.f;
  const float radius = surfel_radius(p);
  const bool seen = alive && classic_tiles(p.u0 + p.center_x, p.v0 + p.center_y, radius, view.tiles_x(),
                                           view.tiles_y()).count() > 0;
  s.radius = seen ? to_int(radius, 0, 1 << 30) : 0;
  return s;
}

template <bool kTight>
__global__ void __launch_bounds__(kProjectThreads)
    project_kernel(View<float> view, Gaussians<float> g, float scale_modifier, Splats splats, SplatWork work,
                   int32_t* radii, uint8_t* flags, Counters* counters, uint64_t* states, Published* published) {
  __shared__ Numbering numbering;
  start_numbering(numbering, counters);
  const int64_t n = int64_t(numbering.block) * kProjectThreads + threadIdx.x;
  const bool asked = n < g.count && (g.visible == nullptr || g.visible[n]);

  Screened s;
  s.radius = 0, s.valid = true;
  if (asked) s = screen(view, g, scale_modifier, n);
  const SurfelProjection<float>& p = s.p;
  int32_t tiles = 0;
  float level = 0.f, a = 0.f, b = 0.f, c = 0.f;
  float2 extent = make_float2(0.f, 0.f), center = extent;
  Ellipse<float> ellipse = {};
  bool reaches = false;  // alpha is above 1/255 somewhere
  if (s.radius > 0) {
    level = log_2(fmaxf(s.opacity, 1e-30f));
    const float cutoff = cutoff_of(level);
    reaches = cutoff > kCutoffShift;
    if (reaches) {
      const float reach = cutoff * float(2 * kLn2);
      const SurfelBound<float> bound = surfel_bound(view, p, reach);
      a = float(-0.5 * kLog2e) * bound.ka, b = float(-kLog2e) * bound.kb, c = float(-0.5 * kLog2e) * bound.kc;
      extent = make_float2(square_root(reach * bound.c00), square_root(reach * bound.c11));
      center = make_float2(bound.u, bound.v);
      if constexpr (kTight) {
        ellipse = ellipse_of(bound.u, bound.v, a, b, c, level, extent);
      } else {
        center = make_float2(p.u0 + p.center_x, p.v0 + p.center_y);
        tiles = classic_tiles(center.x, center.y, float(s.radius), view.tiles_x(), view.tiles_y()).count();
      }
    }
  }
  if constexpr (kTight) tiles = count_tiles(view, reaches, ellipse);
  const bool drawn = tiles > 0;
  if (n < g.count) {
    radii[n] = s.radius;
    if (flags != nullptr) flags[n] = drawn ? kDrawn : 0;
  }

  const unsigned slot = take_number(numbering, counters, states, {s.radius > 0, drawn, !s.valid, unsigned(tiles)});
  if (drawn) {
    splats.shape[2 * int64_t(slot)] = make_float4(center.x, center.y, a, b);
    splats.shape[2 * int64_t(slot) + 1] = make_float4(c, level, 0.f, 0.f);
    splats.tail[slot] = make_float2(0.f, __int_as_float(int(n)));
    static_assert(kPlane == 16);
    float4* plane = reinterpret_cast<float4*>(splats.channels) + 4 * int64_t(slot);
    plane[0] = make_float4(p.a, p.b, p.c, p.d);
    plane[1] = make_float4(p.e, p.f, p.u0, p.v0);
    plane[2] = make_float4(p.center_x, p.center_y, p.t[2], 1.f / p.t[2]);
    plane[3] = make_float4(p.sign * p.axes[2], p.sign * p.axes[5], p.sign * p.axes[8], p.t[2] / view.near);
    work.depth[slot] = __float_as_uint(p.t[2]);
    work.extent[slot] = extent;
    work.tiles[slot] = tiles;
    work.order[slot] = int32_t(slot);
    if constexpr (!kTight) work.radius[slot] = s.radius;
  }
  publish(numbering, counters, published);
}

__global__ void __launch_bounds__(kProjectThreads)
    radii_kernel(View<float> view, Gaussians<float> g, float scale_modifier, int32_t* radii) {
  const int64_t n = int64_t(blockIdx.x) * kProjectThreads + threadIdx.x;
  if (n >= g.count) return;
  radii[n] = g.visible == nullptr || g.visible[n] ? screen(view, g, scale_modifier, n).radius : 0;
}

}  // namespace

void project_surfels(const View<float>& view, const Gaussians<float>& g, const Settings& settings, const Splats& splats,
                     const SplatWork& work, int32_t* radii, uint8_t* flags, Counters* counters, uint64_t* states,
                     Published* published, cudaStream_t stream) {
  const auto kernel = settings.tight ? project_kernel<true> : project_kernel<false>;
  kernel<<<unsigned(ceil_div(g.count, kProjectThreads)), kProjectThreads, 0, stream>>>(
      view, g, float(settings.scale_modifier), splats, work, radii, flags, counters, states, published);
}

void visible_surfel_radii(const View<float>& view, const Gaussians<float>& g, const Settings& settings, int32_t* radii,
                          cudaStream_t stream) {
  radii_kernel<<<unsigned(ceil_div(g.count, kProjectThreads)), kProjectThreads, 0, stream>>>(
      view, g, float(settings.scale_modifier), radii);
}

}  // namespace sw::cuda
