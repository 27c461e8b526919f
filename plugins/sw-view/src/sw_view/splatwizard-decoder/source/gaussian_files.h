// The files of explicit Gaussians (docs/bitstream.md, the files of each method).
#pragma once
#include "container.h"

namespace swz {

struct Gaussians;

void decode_exact(Container& file);
void decode_quantized(Container& file);
void decode_tiles(Container& file);
void decode_lossless(Container& file);
void decode_ply(Container& file);
void decode_vectree(Container& file);
void decode_indexed(Container& file);
void decode_raht(Container& file);
void decode_gsc_quant(Container& file);
void decode_chimera(Container& file);
void decode_compact(Container& file);
void decode_wisp(Container& file);

// Rows of opacity logit, three log scales and quaternion, of Gaussians from `first` on.
void put_attributes(const Gaussians& to, int64_t first, int64_t count, const float* attributes);

// 3, or 2 for surfels.
int64_t stated_scales(const Container& file);

}  // namespace swz
