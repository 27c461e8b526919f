// From the rows of sums to the gradients of the inputs: as project_backward.cu.
#include "color_backward.h"
#include "surfel_kernels.h"

namespace sw::cuda {
namespace {

constexpr int kThreads = 128, kWarps = kThreads / kWarp;

template <bool kWithMaps>
__global__ void __launch_bounds__(kThreads)
    project_backward_kernel(View<float> view, Gaussians<float> g, float scale_modifier, const uint8_t* flags,
                            const float* rows, Gradients<float> out) {
  constexpr int kColumns = kWithMaps ? int(kSurfelColumns) : int(kSurfelPlain);
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

  SurfelGradient<float> result = {};
  float color[3] = {}, basis[kMaxBasis] = {};
  float direction[3] = {0.f, 0.f, 1.f}, inverse_length = 0.f;
  if (drawn) {
    float sums[kSurfelColumns] = {};
#pragma unroll
    for (int k = 0; k < kColumns; k += 4) {
      const float4 quad = reinterpret_cast<const float4*>(rows)[(n * kColumns + k) / 4];
      sums[k] = quad.x, sums[k + 1] = quad.y, sums[k + 2] = quad.z, sums[k + 3] = quad.w;
    }
#pragma unroll
    for (int k = 0; k < 3; ++k) color[k] = sums[kSumRed + k];
    SurfelGeometry<float> in;
    load_row<3>(g.means, n, in.mean);
    load_row<2>(g.scales, n, in.scale);
    load_row<4>(g.quats, n, in.quat);
    SurfelProjection<float> p;
    project_surfel(view, scale_modifier, in, p);
    surfel_backward(view, scale_modifier, p, g.opacities[n], sums, kWithMaps, result);
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
  }

  if (through_direction) {
    async_wait();
    __syncwarp();
    if (drawn) add_color_slope(degree, direction, inverse_length, rest, color, result.mean);
  }

  if (exists) {
    if (out.means != nullptr) store_row<3>(out.means, n, result.mean);
    if (out.opacities != nullptr) out.opacities[n] = result.opacity;
    if (out.scales != nullptr) store_row<2>(out.scales, n, result.scale);
    if (out.quats != nullptr) store_row<4>(out.quats, n, result.quat);
    if (out.colors != nullptr) store_row<3>(out.colors, n, color);
    if (out.grad2d != nullptr)  // NDC units: pixel gradient times half the image size
      reinterpret_cast<float2*>(out.grad2d)[n] =
          make_float2(0.5f * view.width * result.shift_x, 0.5f * view.height * result.shift_y);
  }
  write_sh_gradient(g, out, first, basis, color, shared);
}

}  // namespace

void project_surfels_backward(const View<float>& view, const Gaussians<float>& g, const Settings& settings,
                              const uint8_t* flags, const float* rows, bool maps, const Gradients<float>& out,
                              cudaStream_t stream) {
  const auto kernel = maps ? project_backward_kernel<true> : project_backward_kernel<false>;
  kernel<<<unsigned(ceil_div(g.count, kThreads)), kThreads, 0, stream>>>(view, g, float(settings.scale_modifier), flags,
                                                                         rows, out);
}

}  // namespace sw::cuda
