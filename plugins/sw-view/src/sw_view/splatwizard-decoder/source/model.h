// What a decoder hands out: named arrays in the order of the hash point (docs/bitstream.md, the hash of a decoded model).
#pragma once
#include "base.h"

namespace swz {

constexpr int MAX_ARRAYS = 32;

// As the host reads it: 32-bit fields.
struct Array {
  const char* name;
  float* data;
  int32_t axes;
  uint32_t shape[4];
};

struct Model3D {
  Array arrays[MAX_ARRAYS];
  int32_t count = 0;

  // A new array [first, ...] of zeros; an axis of -1 is none.
  float* add(const char* name, int64_t first, int64_t second = -1, int64_t third = -1);
  // Refuses numbers that are not finite.
  void check_finite() const;
};

extern Model3D decoded;

// Raw parameters of Gaussians, empty.
struct Gaussians {
  float *means, *log_scales, *quats, *opacity_logits, *sh_dc, *sh_rest;
  int64_t count, rest;

  Gaussians(int64_t gaussians, int64_t sh_degree, int64_t scales);
};

}  // namespace swz
