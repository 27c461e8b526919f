// Coder of vectors `residual-vq` (docs/bitstream.md).
#pragma once
#include "container.h"

namespace swz {

// Vectors [count, width]: sums of entries. `sections` are those of the parts header, codebooks and indices.
Buffer<float> residual_vq(Container& file, const char* const (&sections)[3], int64_t count, int64_t width);

}  // namespace swz
