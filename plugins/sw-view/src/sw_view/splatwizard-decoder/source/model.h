// What a decoder hands out: named arrays in the order of the hash point (docs/bitstream.md, the hash of a decoded model).
#pragma once
#include "base.h"

namespace swz {

constexpr int MAX_ARRAYS = 32;

// As the host reads it: 32-bit fields.
struct Array {
  const char* name;
  void* data;
  int32_t is_index;  // 0: float32, part of the hash; 1: uint32, which rows of other arrays a Gaussian takes
  int32_t axes;
  uint32_t shape[4];

  int64_t size() const;
};

struct Model3D {
  Array arrays[MAX_ARRAYS];
  int32_t count = 0;

  // A new array [first, ...] of zeros; an axis of -1 is none.
  float* add(const char* name, int64_t first, int64_t second = -1, int64_t third = -1);
  uint32_t* add_index(const char* name, int64_t length);
  void clear();
  // Refuses numbers that are not finite.
  void check_finite() const;
};

extern Model3D decoded;

struct Sha256;
// Hashes the integers that decoders agree on, where it is not the arrays of floats; null: those.
extern void (*hash_of_integers)(Sha256& sha);

// Raw parameters of Gaussians, empty.
struct Gaussians {
  float *means, *log_scales, *quats, *opacity_logits, *sh_dc, *sh_rest;
  int64_t count, rest;

  Gaussians() = default;
  Gaussians(int64_t gaussians, int64_t sh_degree, int64_t scales);

  // Goes on behind so many Gaussians.
  void advance(int64_t gaussians, int64_t scales) {
    means += 3 * gaussians, log_scales += scales * gaussians, quats += 4 * gaussians, opacity_logits += gaussians;
    sh_dc += 3 * gaussians, sh_rest += 3 * rest * gaussians;
  }

  // Coefficients of band 0, then the others of red, of green, of blue, as SH of one Gaussian.
  void put_sh(int64_t gaussian, const float* coefficients, int64_t others) const {
    for (int64_t color = 0; color < 3; ++color) {
      sh_dc[3 * gaussian + color] = coefficients[color];
      for (int64_t k = 0; k < others; ++k)
        sh_rest[3 * (rest * gaussian + k) + color] = coefficients[3 + others * color + k];
    }
  }
};

}  // namespace swz
