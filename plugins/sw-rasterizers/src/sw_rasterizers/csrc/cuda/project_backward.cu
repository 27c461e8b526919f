// From the rows of sums to the gradients of the inputs.
//
// One thread a Gaussian; those that were not drawn get zeros, so no gradient needs to be cleared before. The projection
// is computed again, which is cheaper than to have stored it.
#include "color_backward.h"
#include "kernels.h"

namespace sw::cuda {
namespace {

constexpr int kThreads = 128, kWarps = kThreads / kWarp;

// From dL/d(scales as drawn) and dL/dquat to what was put in; rows that several Gaussians share start at 0.
__device__ __forceinline__ void write_shape_gradient(const Gaussians<float>& g, const Gradients<float>& out, int64_t n,
                                                     bool drawn, GeometryGradient<float>& result) {
  const int64_t shape = g.shape_of(n);
  if (g.scale_factors != nullptr) {
    float own[3];
    load_row<3>(g.scales, shape, own);
    if (out.scale_factors != nullptr) out.scale_factors[n] = drawn ? dot3(result.scale, own) : 0.f;
    const float factor = g.scale_factors[n];
#pragma unroll
    for (int k = 0; k < 3; ++k) result.scale[k] = drawn ? result.scale[k] * factor : 0.f;
  }
  if (g.shape_rows == nullptr) {
    if (out.scales != nullptr) store_row<3>(out.scales, n, result.scale);
    if (out.quats != nullptr) store_row<4>(out.quats, n, result.quat);
  } else if (drawn) {
    if (out.scales != nullptr)
#pragma unroll
      for (int k = 0; k < 3; ++k) atomicAdd(out.scales + 3 * shape + k, result.scale[k]);
    if (out.quats != nullptr)
#pragma unroll
      for (int k = 0; k < 4; ++k) atomicAdd(out.quats + 4 * shape + k, result.quat[k]);
  }
}

template <bool kCov3d, bool kAdam>
__global__ void __launch_bounds__(kThreads)
    project_backward_kernel(View<float> view, Gaussians<float> g, Settings settings, Channels channels,
                            const uint8_t* flags, Rows rows, Gradients<float> out, ShAdam adam) {
  __shared__ float staged[kWarps * kWarp * kRestFloats];
  const int64_t n = int64_t(blockIdx.x) * kThreads + threadIdx.x, first = n - lane_index();
  if (first >= g.count) return;
  const bool exists = n < g.count;
  const int flag = exists ? flags[n] : 0;
  const bool drawn = flag & kDrawn, shaded = g.sh_dc != nullptr;
  float* shared = staged + warp_index() * kWarp * kRestFloats;
  const int degree = shaded ? g.sh_degree : 0;
  const bool through_direction = degree > 0 && out.means != nullptr;
  const float* rest = shared;
  if (through_direction) rest = stage_rest(g, n, drawn, rest_floats(degree), shared);

  GeometryGradient<float> result = {};
  float color[3] = {}, basis[kMaxBasis] = {}, screen[2] = {}, absolute_screen[2] = {};
  float direction[3] = {0.f, 0.f, 1.f}, inverse_length = 0.f;
  if (drawn) {
    const float* row = rows.base + n * rows.stride;
    float sum[kMomentSums];
#pragma unroll
    for (int k = 0; k < kMomentSums; ++k) sum[k] = row[k];
    int at = kMomentSums;
    for (int k = 0; k < channels.colors; ++k, ++at) {
      if (k < 3) color[k] = row[at];
      if (out.colors != nullptr) out.colors[n * channels.colors + k] = row[at];
    }
    Geometry<float> in;
    load_geometry<kCov3d>(g, n, in);
    const float opacity = g.opacities[n];
    Projection<float> p;
    project<kCov3d>(view, float(settings.scale_modifier), float(settings.eps2d), settings.antialias, in, p);
    ScreenGradient<float> grad;
    grad.depth = 0.f;
    if (channels.inverse) grad.depth -= row[at++] / (p.t[2] * p.t[2]);
    if (channels.accumulated) grad.depth += row[at++];
    for (int k = 0; k < channels.features; ++k, ++at)
      if (out.features != nullptr) out.features[n * channels.features + k] = row[at];
    if (rows.absgrad) absolute_screen[0] = row[at++], absolute_screen[1] = row[at++];
    if (rows.median) grad.depth += row[at];
    grad.u = p.ka * sum[1] + p.kb * sum[2];
    grad.v = p.kb * sum[1] + p.kc * sum[2];
    grad.ka = 0.5f * sum[3], grad.kb = sum[4], grad.kc = 0.5f * sum[5];
    grad.opacity = -sum[0] / (opacity * p.rho);  // the sum of -v is that of alpha dL/dalpha
    screen[0] = grad.u, screen[1] = grad.v;
    project_backward<kCov3d>(view, float(settings.scale_modifier), float(settings.eps2d), settings.antialias,
                             settings.original_jacobian, in, p, opacity, grad, result);
    if (shaded) {
#pragma unroll
      for (int k = 0; k < 3; ++k)
        if (flag >> k & 1) color[k] = 0.f;
      basis[0] = float(kSH0);
      if (degree > 0) {
        inverse_length = view_direction(view, in.mean, direction);
        sh_basis(degree, direction[0], direction[1], direction[2], basis);
      }
    }
  } else if (exists) {
    for (int k = 0; out.colors != nullptr && k < channels.colors; ++k) out.colors[n * channels.colors + k] = 0.f;
    for (int k = 0; out.features != nullptr && k < channels.features; ++k)
      out.features[n * channels.features + k] = 0.f;
  }

  if (through_direction) {
    async_wait();
    __syncwarp();
    if (drawn) add_color_slope(degree, direction, inverse_length, rest, color, result.mean);
  }

  if (exists) {
    if (out.means != nullptr) store_row<3>(out.means, n, result.mean);
    if (out.opacities != nullptr) out.opacities[n] = result.opacity;
    if constexpr (kCov3d) {
      if (out.cov3d != nullptr) store_row<6>(out.cov3d, n, result.cov);
    } else {
      write_shape_gradient(g, out, n, drawn, result);
    }
    // NDC units: pixel gradient times half the image size.
    const float half[2] = {0.5f * view.width, 0.5f * view.height};
    const auto ndc = [&](float* to, const float* pixels) {
      reinterpret_cast<float2*>(to)[n] = make_float2(half[0] * pixels[0], half[1] * pixels[1]);
    };
    if (out.grad2d != nullptr) ndc(out.grad2d, screen);
    if (out.absgrad2d != nullptr && rows.fragments)
      reinterpret_cast<float2*>(out.absgrad2d)[n] = make_float2(absolute_screen[0], absolute_screen[1]);
    else if (out.absgrad2d != nullptr)
      ndc(out.absgrad2d, absolute_screen);
  }
  write_sh_gradient<kAdam>(g, out, first, basis, color, shared, adam);
}

}  // namespace

void project_backward(const View<float>& view, const Gaussians<float>& g, const Settings& settings,
                      const Channels& channels, const uint8_t* flags, const Rows& rows, const Gradients<float>& out,
                      const ShAdam& adam, cudaStream_t stream) {
  const auto kernel =
      g.cov3d != nullptr ? (adam.any() ? project_backward_kernel<true, true> : project_backward_kernel<true, false>)
                         : (adam.any() ? project_backward_kernel<false, true> : project_backward_kernel<false, false>);
  kernel<<<unsigned(ceil_div(g.count, kThreads)), kThreads, 0, stream>>>(view, g, settings, channels, flags, rows, out,
                                                                         adam);
}

}  // namespace sw::cuda
