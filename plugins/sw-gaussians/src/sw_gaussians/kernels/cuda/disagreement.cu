// Normal consistency in one launch each way: written with torch operations it is some hundred, each a launch.
//
// With the pixel's depths below, above, right and left of it
//   a = below - above, p = (below + above) / fy,   b = right - left, q = (right + left) / fx
// the normal of the depth map is along c = (b p, a q, -(p q + a q y + b p x)), as in sw_gaussians/surface.py.
#include "kernels.h"

namespace splatwizard::cuda {
namespace {

constexpr int kWide = 32, kHigh = 8;

struct Cross {
  float a, p, b, q, x, y;
  float c[3];
  float scale;  // 1 / |c|; 0 where the points span no plane
};

__device__ bool inside(const Surface& s, int column, int row) {
  return column >= 1 && row >= 1 && column < s.width - 1 && row < s.height - 1;
}

__device__ Cross cross_at(const Surface& s, int column, int row) {
  const float* d = s.depth + int64_t(row) * s.width + column;
  const float above = d[-s.width], below = d[s.width], left = d[-1], right = d[1];
  Cross r;
  r.x = (column + 0.5f - s.cx) / s.fx;
  r.y = (row + 0.5f - s.cy) / s.fy;
  r.a = below - above;
  r.p = (below + above) / s.fy;
  r.b = right - left;
  r.q = (right + left) / s.fx;
  const float bp = r.b * r.p, aq = r.a * r.q;
  r.c[0] = bp;
  r.c[1] = aq;
  r.c[2] = -(r.p * r.q + aq * r.y + bp * r.x);
  const float squared = r.c[0] * r.c[0] + r.c[1] * r.c[1] + r.c[2] * r.c[2];
  r.scale = squared > 0.f ? rsqrtf(squared) : 0.f;
  return r;
}

__global__ void __launch_bounds__(kWide* kHigh) forward_kernel(const Surface s, float* __restrict out) {
  const int column = blockIdx.x * kWide + threadIdx.x, row = blockIdx.y * kHigh + threadIdx.y;
  if (column >= s.width || row >= s.height) return;
  const int64_t i = int64_t(row) * s.width + column, pixels = int64_t(s.width) * s.height;
  float agreement = 0.f;
  if (inside(s, column, row)) {
    const Cross r = cross_at(s, column, row);
    for (int k = 0; k < 3; ++k) agreement += s.normals[k * pixels + i] * r.c[k];
    agreement *= r.scale * s.alpha[i];
  }
  out[i] = 1.f - agreement;
}

// Derivatives of the loss by a, b, p / fy and q / fx of one pixel.
struct Pull {
  float a, b, p, q;
};

__device__ Pull pull_at(const Surface& s, const float* grad, int column, int row) {
  if (!inside(s, column, row)) return {0.f, 0.f, 0.f, 0.f};
  const int64_t i = int64_t(row) * s.width + column, pixels = int64_t(s.width) * s.height;
  const Cross r = cross_at(s, column, row);
  const float outer = -grad[i] * s.alpha[i];
  float v[3], along = 0.f;
  for (int k = 0; k < 3; ++k) {
    v[k] = outer * s.normals[k * pixels + i];
    along += v[k] * r.c[k] * r.scale;
  }
  for (int k = 0; k < 3; ++k) v[k] = (v[k] - r.c[k] * r.scale * along) * r.scale;
  const float to_bp = v[0] - r.x * v[2], to_aq = v[1] - r.y * v[2];
  return {r.q * to_aq, r.p * to_bp, (r.b * to_bp - r.q * v[2]) / s.fy, (r.a * to_aq - r.p * v[2]) / s.fx};
}

__global__ void __launch_bounds__(kWide* kHigh)
    backward_kernel(const Surface s, const float* __restrict grad, float* __restrict to_depth,
                    float* __restrict to_normals) {
  const int column = blockIdx.x * kWide + threadIdx.x, row = blockIdx.y * kHigh + threadIdx.y;
  if (column >= s.width || row >= s.height) return;
  const int64_t i = int64_t(row) * s.width + column, pixels = int64_t(s.width) * s.height;
  float unit[3] = {0.f, 0.f, 0.f};
  if (inside(s, column, row)) {
    const Cross r = cross_at(s, column, row);
    for (int k = 0; k < 3; ++k) unit[k] = r.c[k] * r.scale;
  }
  const float outer = -grad[i] * s.alpha[i];
  for (int k = 0; k < 3; ++k) to_normals[k * pixels + i] = outer * unit[k];
  // Collected from the four pixels that read this depth, so that nothing is added in any order.
  const Pull over = pull_at(s, grad, column, row - 1), under = pull_at(s, grad, column, row + 1),
             before = pull_at(s, grad, column - 1, row), after = pull_at(s, grad, column + 1, row);
  to_depth[i] = (over.p + over.a) + (under.p - under.a) + (before.q + before.b) + (after.q - after.b);
}

dim3 blocks(const Surface& s) { return dim3((s.width + kWide - 1) / kWide, (s.height + kHigh - 1) / kHigh); }

}  // namespace

void disagreement(const Surface& surface, float* out, cudaStream_t stream) {
  if (surface.width > 0 && surface.height > 0)
    forward_kernel<<<blocks(surface), dim3(kWide, kHigh), 0, stream>>>(surface, out);
}

void disagreement_backward(const Surface& surface, const float* grad, float* to_depth, float* to_normals,
                           cudaStream_t stream) {
  if (surface.width > 0 && surface.height > 0)
    backward_kernel<<<blocks(surface), dim3(kWide, kHigh), 0, stream>>>(surface, grad, to_depth, to_normals);
}

}  // namespace splatwizard::cuda
