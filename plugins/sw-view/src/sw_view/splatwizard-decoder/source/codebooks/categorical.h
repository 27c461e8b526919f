// Entropy model `categorical` with one table, coded by `range` (docs/bitstream.md).
#pragma once
#include "base.h"

namespace swz {

void categorical(Bytes data, int64_t size, int64_t count, uint32_t* to);

}  // namespace swz
