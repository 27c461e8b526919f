// Gaussians that anchors spawn, from the outputs of their networks, and the gradient: one Gaussian; the same for the CPU
// and for CUDA. Memory is row-major; n anchors, k offsets each.
#pragma once

#include <cmath>
#include <cstdint>

#if defined(__CUDACC__)
#define SW_SPAWN_HD __host__ __device__ __forceinline__
#else
#define SW_SPAWN_HD inline __attribute__((always_inline))
#endif

namespace sw_anchors {

constexpr int kGeometry = 7;            // outputs of the covariance network a Gaussian: 3 factors, 4 of the quaternion
constexpr float kShortest = 1e-12f;     // floor of a quaternion's norm

struct Anchors {
  int64_t n, k;
  const float* alpha;      // [n,k] opacities before masks
  const float* geometry;   // [n,7k]
  const float* color;      // [n,3k] before the sigmoid
  const float* positions;  // [n,3]
  const float* offsets;    // [n,3k], rows `offset_row` apart
  const float* scales;     // [n,6], rows `scale_row` apart
  const float* masks;      // [n,k] or null
  int64_t offset_row, scale_row;
  const int64_t* drawn;    // [count] ascending numbers of Gaussians in 0 .. n k - 1
  int64_t count;
  bool compact;            // geometry [count,7] and color [count,3], and their gradients, are of the drawn ones alone
};

struct Gaussians {  // [count, ...], or gradients by them
  float *means, *opacities, *scales, *quats, *colors;
};

struct Gradients {  // of the members of Anchors; masks and positions or null; offsets and scales without gaps
  float *alpha, *geometry, *color, *offsets, *scales, *masks, *positions;
};

SW_SPAWN_HD float sigmoid(float x) { return 1.f / (1.f + expf(-x)); }

// Sigmoids of the outputs, by their place in Anchors::geometry and color.
struct Sigmoids {
  const Anchors& from;
  SW_SPAWN_HD float geometry(int64_t at) const { return sigmoid(from.geometry[at]); }
  SW_SPAWN_HD float color(int64_t at) const { return sigmoid(from.color[at]); }
};

template <class Found>
SW_SPAWN_HD void spawn_one(const Anchors& from, int64_t m, const Gaussians& to, const Found& sigmoids) {
  const int64_t i = from.drawn[m], a = i / from.k, j = i % from.k, own = from.compact ? m : i;
  const float* geometry = from.geometry + kGeometry * own;
  const float* scale = from.scales + a * from.scale_row;
  const float* offset = from.offsets + a * from.offset_row + 3 * j;
  for (int axis = 0; axis < 3; ++axis) {
    to.means[3 * m + axis] = from.positions[3 * a + axis] + offset[axis] * scale[axis];
    // Noise or rounding may take a base scale through zero: a Gaussian of scale -s is that of scale s.
    to.scales[3 * m + axis] = fabsf(scale[3 + axis]) * sigmoids.geometry(kGeometry * own + axis);
    to.colors[3 * m + axis] = sigmoids.color(3 * own + axis);
  }
  const float* q = geometry + 3;
  const float norm = fmaxf(sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), kShortest);
  for (int c = 0; c < 4; ++c) to.quats[4 * m + c] = q[c] / norm;
  to.opacities[m] = from.masks == nullptr ? from.alpha[i] : from.alpha[i] * from.masks[i];
}
SW_SPAWN_HD void spawn_one(const Anchors& from, int64_t m, const Gaussians& to) {
  spawn_one(from, m, to, Sigmoids{from});
}

// Writes what belongs to the Gaussian alone; add(place, value) sums what it shares with the others of its anchor.
template <class Add, class Found>
SW_SPAWN_HD void spawn_one_backward(const Anchors& from, int64_t m, const Gaussians& slope, const Gradients& to,
                                    const Add& add, const Found& sigmoids) {
  const int64_t i = from.drawn[m], a = i / from.k, j = i % from.k, own = from.compact ? m : i;
  const float* geometry = from.geometry + kGeometry * own;
  const float* scale = from.scales + a * from.scale_row;
  const float* offset = from.offsets + a * from.offset_row + 3 * j;
  for (int axis = 0; axis < 3; ++axis) {
    const float to_mean = slope.means[3 * m + axis], to_size = slope.scales[3 * m + axis];
    const float factor = sigmoids.geometry(kGeometry * own + axis), base = scale[3 + axis];
    const float color = sigmoids.color(3 * own + axis);
    to.offsets[3 * i + axis] = to_mean * scale[axis];
    add(to.scales + 6 * a + axis, to_mean * offset[axis]);
    add(to.scales + 6 * a + 3 + axis, base > 0.f ? to_size * factor : base < 0.f ? -to_size * factor : 0.f);
    to.geometry[kGeometry * own + axis] = to_size * fabsf(base) * factor * (1.f - factor);
    to.color[3 * own + axis] = slope.colors[3 * m + axis] * color * (1.f - color);
    if (to.positions != nullptr) add(to.positions + 3 * a + axis, to_mean);
  }
  const float* q = geometry + 3;
  const float* to_quat = slope.quats + 4 * m;
  const float norm = fmaxf(sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), kShortest);
  float along = 0.f;
  for (int c = 0; c < 4; ++c) along += q[c] / norm * to_quat[c];
  for (int c = 0; c < 4; ++c) to.geometry[kGeometry * own + 3 + c] = (to_quat[c] - q[c] / norm * along) / norm;
  to.alpha[i] = from.masks == nullptr ? slope.opacities[m] : slope.opacities[m] * from.masks[i];
  if (to.masks != nullptr) to.masks[i] = slope.opacities[m] * from.alpha[i];
}
template <class Add>
SW_SPAWN_HD void spawn_one_backward(const Anchors& from, int64_t m, const Gaussians& slope, const Gradients& to,
                                    const Add& add) {
  spawn_one_backward(from, m, slope, to, add, Sigmoids{from});
}

}  // namespace sw_anchors
