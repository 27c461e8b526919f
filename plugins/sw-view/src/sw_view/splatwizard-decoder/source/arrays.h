// Coders of arrays: `byte-planes`, `float-delta`, `deflate`, `packed-bits` (docs/bitstream.md, positions and plain numbers).
#pragma once
#include "base.h"

namespace swz {

// Values of `rows` rows of `width` numbers of `size` bytes each, little-endian, row after row.
Buffer<uint8_t> byte_planes(Bytes data, int64_t rows, int64_t width, int size);
Buffer<uint8_t> deflated(Bytes data, int64_t rows, int64_t width, int size);

// Which of the two a name stands for; refuses others.
using ArrayCoder = Buffer<uint8_t> (*)(Bytes, int64_t, int64_t, int);
ArrayCoder array_coder(const char* name);

void float_delta(Bytes data, int64_t rows, int64_t width, float* to);

// Integers of `width` bits, each from its most significant bit down.
void packed_bits(Bytes data, int64_t count, int width, uint32_t* to);

float half(const uint8_t* bytes);  // a float16, little-endian

inline float float_at(const uint8_t* bytes) {
  float value;
  std::memcpy(&value, bytes, 4);
  return value;
}

// Float16 as float32; refuses what is not finite.
Buffer<float> finite_halves(const Buffer<uint8_t>& halves);

inline void check_finite(const float* values, int64_t count) {
  for (int64_t i = 0; i < count; ++i)
    if (!__builtin_isfinite(values[i])) refuse("holds values that are not finite");
}

}  // namespace swz
