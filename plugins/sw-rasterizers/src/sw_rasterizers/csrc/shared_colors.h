// What shading from a codebook is about: the Gaussians, whose coefficients they read, how. The same for the CPU and the
// CUDA kernels; all pointers are of one device.
#pragma once

#include <cstdint>

namespace splatwizard {
struct Parallel;
}

namespace sw {

template <class S>
struct SharedColors {
  int64_t count, entries;
  const S* means;       // [N][3]
  const S* dc;          // [N][3] coefficient 0 of each Gaussian, or null
  const S* codebook;    // [entries][stride]: coefficients from `first` on, three channels each
  int64_t stride;
  int first;            // 0, or 1 behind dc
  const int64_t* rows;  // [N]
  const S* center;      // [3]
  int degree;
  bool clamp;           // negative colours become 0
  const splatwizard::Parallel* parallel = nullptr;  // threads of the CPU; null: the caller's
};

}  // namespace sw
