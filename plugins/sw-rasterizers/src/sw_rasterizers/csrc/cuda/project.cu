// Projection: culls and projects all Gaussians, and gives those that are drawn a number, in index order.
//
// One thread a Gaussian.
#include "gather.h"
#include "kernels.h"
#include "numbering.h"
#include "splat.h"

namespace sw::cuda {
namespace {

struct Screened {  // a projected Gaussian, and whether it is drawn
  Projection<float> p;
  float opacity, radius;
  bool valid;   // all values are finite
  bool inside;  // in the depth range, with an extent
};

template <bool kCov3d>
__device__ __forceinline__ Screened screen(const View<float>& view, const Gaussians<float>& g, float scale_modifier,
                                           float eps2d, bool antialias, int64_t n) {
  Screened s;
  Geometry<float> in;
  load_geometry<kCov3d>(g, n, in);
  s.opacity = g.opacities != nullptr ? g.opacities[n] : 1.f;
  float probe = finite_probe(s.opacity);
#pragma unroll
  for (int k = 0; k < 3; ++k) probe += finite_probe(in.mean[k]);
  if constexpr (kCov3d) {
#pragma unroll
    for (int k = 0; k < 6; ++k) probe += finite_probe(in.cov[k]);
  } else {
#pragma unroll
    for (int k = 0; k < 3; ++k) probe += finite_probe(in.scale[k]);
#pragma unroll
    for (int k = 0; k < 4; ++k) probe += finite_probe(in.quat[k]);
  }
  s.valid = probe == 0.f;
  Projection<float>& p = s.p;
  project<kCov3d>(view, scale_modifier, eps2d, antialias, in, p);
  const float derived = finite_probe(p.u) + finite_probe(p.v) + finite_probe(p.det) + finite_probe(p.ka) +
                        finite_probe(p.kb) + finite_probe(p.kc);
  s.inside = s.valid && derived == 0.f && p.t[2] > view.near && p.t[2] < view.far && p.det > 0.f && p.c00 > 0.f &&
             p.c11 > 0.f && s.opacity >= 0.f;
  s.radius = bounding_radius(p);
  return s;
}

__device__ __forceinline__ int32_t classic_radius(const View<float>& view, const Screened& s) {
  const bool seen =
      s.inside && classic_tiles(s.p.u, s.p.v, s.radius, view.tiles_x(), view.tiles_y()).count() > 0;
  return seen ? to_int(s.radius, 0, 1 << 30) : 0;
}

template <bool kCov3d, bool kTight>
__global__ void __launch_bounds__(kProjectThreads)
    project_kernel(View<float> view, Gaussians<float> g, float scale_modifier, float eps2d, bool antialias,
                   Splats splats, SplatWork work, int32_t* radii, uint8_t* flags, Counters* counters, uint64_t* states,
                   Published* published) {
  __shared__ Numbering numbering;
  start_numbering(numbering, counters);
  const int64_t n = int64_t(numbering.block) * kProjectThreads + threadIdx.x;
  const bool asked = n < g.count && (g.visible == nullptr || g.visible[n]);

  bool invalid = false;
  int32_t radius = 0, tiles = 0;
  float level = 0.f, a = 0.f, b = 0.f, c = 0.f;
  float2 extent = make_float2(0.f, 0.f);
  Ellipse<float> ellipse = {};
  bool reaches = false;  // alpha is above 1/255 somewhere
  Screened s;
  if (asked) {
    s = screen<kCov3d>(view, g, scale_modifier, eps2d, antialias, n);
    invalid = !s.valid;
    radius = classic_radius(view, s);
  }
  if (radius > 0) {
    const Projection<float>& p = s.p;
    level = log_2(fmaxf(s.opacity * p.rho, 1e-30f));
    const float cutoff = cutoff_of(level);
    reaches = cutoff > kCutoffShift;
    if (reaches) {
      const float two_ln2_cutoff = cutoff * float(2 * kLn2);
      a = float(-0.5 * kLog2e) * p.ka, b = float(-kLog2e) * p.kb, c = float(-0.5 * kLog2e) * p.kc;
      extent = make_float2(square_root(two_ln2_cutoff * p.c00), square_root(two_ln2_cutoff * p.c11));
      if constexpr (kTight)
        ellipse = ellipse_of(p.u, p.v, a, b, c, level, extent);
      else
        tiles = classic_tiles(p.u, p.v, float(radius), view.tiles_x(), view.tiles_y()).count();
    }
  }
  if constexpr (kTight) tiles = count_tiles(view, reaches, ellipse);
  const bool drawn = tiles > 0;
  if (n < g.count) {
    radii[n] = radius;
    if (flags != nullptr) flags[n] = drawn ? kDrawn : 0;
  }

  const unsigned slot = take_number(numbering, counters, states, {radius > 0, drawn, invalid, unsigned(tiles)});
  if (drawn) {
    splats.shape[2 * slot] = make_float4(s.p.u, s.p.v, a, b);
    splats.shape[2 * slot + 1] = make_float4(c, level, 0.f, 0.f);
    splats.tail[slot] = make_float2(0.f, __int_as_float(int(n)));
    work.depth[slot] = __float_as_uint(s.p.t[2]);
    work.extent[slot] = extent;
    work.tiles[slot] = tiles;
    work.order[slot] = int32_t(slot);
    if constexpr (!kTight) work.radius[slot] = radius;
  }
  publish(numbering, counters, published);
}

template <bool kCov3d>
__global__ void __launch_bounds__(kProjectThreads)
    radii_kernel(View<float> view, Gaussians<float> g, float scale_modifier, float eps2d, int32_t* radii) {
  const int64_t n = int64_t(blockIdx.x) * kProjectThreads + threadIdx.x;
  if (n >= g.count) return;
  int32_t radius = 0;
  if (g.visible == nullptr || g.visible[n])
    radius = classic_radius(view, screen<kCov3d>(view, g, scale_modifier, eps2d, false, n));
  radii[n] = radius;
}

}  // namespace

void project(const View<float>& view, const Gaussians<float>& g, const Settings& settings, const Splats& splats,
             const SplatWork& work, int32_t* radii, uint8_t* flags, Counters* counters, uint64_t* states,
             Published* published, cudaStream_t stream) {
  const auto kernel = g.cov3d != nullptr ? (settings.tight ? project_kernel<true, true> : project_kernel<true, false>)
                                         : (settings.tight ? project_kernel<false, true> : project_kernel<false, false>);
  const unsigned blocks = unsigned(ceil_div(g.count, kProjectThreads));
  kernel<<<blocks, kProjectThreads, 0, stream>>>(view, g, float(settings.scale_modifier), float(settings.eps2d),
                                                 settings.antialias, splats, work, radii, flags,
                                                 counters, states, published);
}

void visible_radii(const View<float>& view, const Gaussians<float>& g, const Settings& settings, int32_t* radii,
                   cudaStream_t stream) {
  const auto kernel = g.cov3d != nullptr ? radii_kernel<true> : radii_kernel<false>;
  kernel<<<unsigned(ceil_div(g.count, kProjectThreads)), kProjectThreads, 0, stream>>>(
      view, g, float(settings.scale_modifier), float(settings.eps2d), radii);
}

}  // namespace sw::cuda
