// Functions of probability on vectors of float32.
#pragma once

#include <splatwizard/vectors.h>

namespace SW_ARCH {

inline Vec magnitude(Vec x) { return x < Vec{} ? -x : x; }

// Complementary error function within 1.2e-7 of itself and float32's rounding.
// Source: Press et al., Numerical Recipes, 2nd edition, 6.2 (a Chebyshev fit).
inline Vec erfc(Vec x) {
  const Vec away = magnitude(x), t = all(1.f) / (all(1.f) + all(0.5f) * away);
  Vec sum = all(0.17087277f);
  for (const float c : {-0.82215223f, 1.48851587f, -1.13520398f, 0.27886807f, -0.18628806f, 0.09678418f, 0.37409196f,
                        1.00002368f, -1.26551223f})
    sum = sum * t + all(c);
  const Vec right = t * exponential(sum - away * away);
  return x < Vec{} ? all(2.f) - right : right;
}

}  // namespace SW_ARCH
