// Bits of learned planes under a spatial model, and their gradients: what the CPU and CUDA share.
//
// Each value x of a plane is predicted from twelve neighbours, two rows above and two values to the left, zeros beyond
// the border: 12 -> 16, ReLU; three times 16 -> 16 plus its input, ReLU; 16 -> 2, mean m and s. Its bits are
// -log2 max(p, 2^-16), p the mass of [x - 1/2, x + 1/2] under a Laplacian of mean m and scale exp(-s/2), which is kept
// to 0.05 .. 64. Source: CAT-3DGS (arXiv 2503.00357). The form in torch: context/spatial_ar.py.
#pragma once

#include <cmath>
#include <cstdint>

#ifdef __CUDACC__
#define SW_PLANES_INLINE __host__ __device__ __forceinline__
#else
#define SW_PLANES_INLINE inline
#endif

namespace sw_planes {

constexpr int kNeighbors = 12, kHidden = 16, kResiduals = 3;
constexpr int kScales = 4;  // planes of different sizes that are taken together
constexpr int kAbove = 2, kBeside = 2;

// Where weights and biases of the layers start in the parameters of one network.
constexpr int kFirst = 0, kFirstBias = kFirst + kHidden * kNeighbors;
constexpr int kMiddle = kFirstBias + kHidden, kMiddleSize = kHidden * kHidden + kHidden;
constexpr int kLast = kMiddle + kResiduals * kMiddleSize, kLastBias = kLast + 2 * kHidden;
constexpr int kParameters = kLastBias + 2;
// Of what is summed over values: gradients by the parameters, the bits, and a number that keeps rows aligned.
constexpr int kSums = kParameters + 2;
static_assert(kParameters == 1058 && kMiddle % 4 == 0 && kMiddleSize % 4 == 0 && kSums % 4 == 0);

// Planes [orientations, channels, height, width] of each scale; `to` may be null.
struct Planes {
  int scales, orientations, channels;
  int height[kScales], width[kScales];
  int64_t count[kScales];  // of values of one orientation
  const float* values[kScales];
  float* to[kScales];  // gradients, which hold zeros before
  // Where gradients are to be summed in one order: of each warp's 32 values their sums by line, those within the
  // places of these values and those beyond. Null: they are added by atomics.
  float* parts[kScales];  // [orientations][part_sums]
};

constexpr int kTogether = 32, kLines = kAbove + 1;  // values of a warp; lines that their neighbours are in

SW_PLANES_INLINE int groups_of(const Planes& planes, int scale) {
  return int((planes.count[scale] + kTogether - 1) / kTogether);
}

// Numbers of `parts` for one orientation of a scale: [groups][kLines][within, beyond][kTogether].
SW_PLANES_INLINE int64_t part_sums(const Planes& planes, int scale) {
  return int64_t(groups_of(planes, scale)) * kLines * 2 * kTogether;
}

struct Place {
  int scale, row, column;
  int64_t at;  // in values[scale]
};

// Value `index` of a scale and an orientation. Planes have fewer than 2^31 values.
SW_PLANES_INLINE Place place_of(const Planes& planes, int orientation, int scale, int index) {
  const unsigned at = unsigned(index), width = unsigned(planes.width[scale]), line = at / width;
  return {scale, int(line % unsigned(planes.height[scale])), int(at - line * width),
          at + orientation * planes.count[scale]};
}

// Neighbour i of a place: rows down, columns right.
SW_PLANES_INLINE int down_of(int i) { return i < 5 ? -2 : i < 10 ? -1 : 0; }
SW_PLANES_INLINE int right_of(int i) { return (i < 10 ? i % 5 : i - 10) - 2; }

// Neighbours that a place has, a bit each.
SW_PLANES_INLINE unsigned neighbors_of(const Planes& planes, const Place& place) {
  constexpr int kAcross = 2 * kBeside + 1;
  unsigned across = 0;
  for (int i = 0; i < kAcross; ++i)
    across |= unsigned(unsigned(place.column + i - kBeside) < unsigned(planes.width[place.scale])) << i;
  return (place.row > 1 ? across : 0) | (place.row > 0 ? across << kAcross : 0) |
         (across & ((1u << kBeside) - 1)) << (kAbove * kAcross);
}

SW_PLANES_INLINE int64_t neighbor_of(const Planes& planes, const Place& place, int i) {
  return place.at + int64_t(down_of(i)) * planes.width[place.scale] + right_of(i);
}

constexpr float kLowest = -8.3177661667f, kHighest = 5.9914645471f;  // of s: -2 ln 64 and -2 ln 0.05
constexpr float kFloor = 0x1p-16f;

struct Slopes {
  float x, mean, s;
};

// Bits of x, and their derivatives. Below its floor a probability still has the gradient that raises it, and a scale
// out of range that which brings it back.
SW_PLANES_INLINE float laplace_bits(float x, float mean, float s, Slopes& slope) {
  const float offset = x - mean, away = fabsf(offset);
  const float narrowing = expf(0.5f * fminf(fmaxf(s, kLowest), kHighest));  // 1 / scale
  const float near = (away - 0.5f) * narrowing, far = (away + 0.5f) * narrowing;
  const float at_near = 0.5f * expf(-fabsf(near)), at_far = 0.5f * expf(-far);
  const float p = fmaxf((near >= 0.f ? at_near : 1.f - at_near) - at_far, kFloor);
  const float by_p = -1.4426950409f / p;  // d(-log2 p) / dp
  const float to_far = by_p * at_far, to_near = -by_p * at_near;
  const float sign = offset > 0.f ? 1.f : offset < 0.f ? -1.f : 0.f;
  slope.x = (to_near + to_far) * narrowing * sign;
  slope.mean = -slope.x;
  const float to_s = 0.5f * (to_near * near + to_far * far);
  slope.s = (s >= kLowest || to_s < 0.f) && (s <= kHighest || to_s > 0.f) ? to_s : 0.f;
  return -log2f(p);
}

}  // namespace sw_planes
