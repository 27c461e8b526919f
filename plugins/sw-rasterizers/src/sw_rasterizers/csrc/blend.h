// What one pixel does with one splat: the compositing recurrences of 3DGS, front to back and back to front.
//
// A splat arrives in exponent form (base 2): log2 alpha = A dx^2 + B dx dy + C dy^2 + L with A = -Ka log2(e)/2,
// B = -Kb log2(e), C = -Kc log2(e)/2, L = log2(effective opacity). A finished pixel carries its transmittance with a
// minus sign: every later splat then fails the stop test, which is the latch.
#pragma once

#include "common.h"

namespace sw {

// log2 of opacity times the Gaussian. The quadratic form is positive definite; if rounding makes it negative next to
// the ridge of a needle-shaped splat, its value there is 0, hence the minimum.
template <class V>
SW_HD V log2_alpha(V dx, V dy, V a, V b, V c, V level) {
  return at_most(dx * (a * dx + b * dy) + (c * dy * dy + level), level);
}

// Front to back: takes alpha (0 where the splat is skipped), updates the transmittance, returns the weight alpha T,
// which is 0 where the pixel is or becomes finished: below `least`, another one where both are relative to a start.
template <class V>
SW_HD V composite(V alpha, V& transmittance, V least = constant<V>(kTransmittanceMin)) {
  const V zero = constant<V>(0);
  const V weight = alpha * transmittance, next = transmittance - weight;
  const auto live = next >= least;
  transmittance = select(live, next, -absolute(transmittance));
  return select(live, weight, zero);
}

// Back to front: undoes one splat. `transmittance` holds T behind the splat and receives T before it; `behind` is
// (colour behind the splat) . dL/dC, minus T_final dL/dalpha_map; phi = (colour of the splat) . dL/dC.
// Returns dL/dalpha; `weight` receives alpha T. With alpha = 0 nothing changes.
template <class V>
SW_HD V composite_backward(V alpha, V phi, V& transmittance, V& behind, V& weight) {
  const V gain = reciprocal(constant<V>(1) - alpha);
  transmittance *= gain;
  weight = alpha * transmittance;
  const V gradient = transmittance * phi - behind * gain;
  behind += weight * phi;
  return gradient;
}

}  // namespace sw
