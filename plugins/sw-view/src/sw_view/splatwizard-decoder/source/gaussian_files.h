// The files of explicit Gaussians (docs/bitstream.md, the files of each method).
#pragma once
#include "container.h"

namespace swz {

void decode_exact(Container& file);
void decode_quantized(Container& file);

// 3, or 2 for surfels.
int64_t stated_scales(const Container& file);

}  // namespace swz
