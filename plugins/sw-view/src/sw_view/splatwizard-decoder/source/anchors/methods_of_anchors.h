// The files of anchor methods (docs/bitstream.md, the files of each method).
#pragma once
#include "container.h"

namespace swz {

void decode_hac(Container& file);
void decode_hac_plus(Container& file);
void decode_cat(Container& file);

}  // namespace swz
