// Coder of vectors `importance-vq` (docs/bitstream.md).
#pragma once
#include "container.h"

namespace swz {

// The sections of the parts: header, mask, indices, codebook, own. What is wrong with one is blamed on it, or, as a part,
// on the first.
struct VectorParts {
  const char* sections[5];
  bool as_parts;
};

// Vectors [count, width]: those of a codebook, and those that keep their own.
struct Vectors {
  Buffer<float> codebook, own;
  Buffer<uint32_t> code;  // entry of the codebook; above all of them, in order, are the vectors that keep their own
  int64_t width;

  const float* row(int64_t i) const {
    const int64_t entries = codebook.size / width, at = code[i];
    return at < entries ? codebook.data + at * width : own.data + (at - entries) * width;
  }
};

Vectors importance_vq(Container& file, const VectorParts& parts, int64_t count, int64_t width);

}  // namespace swz
