// One zstd frame whose length both sides know (RFC 8878).
#pragma once
#include "base.h"

namespace swz {

// Decodes a frame that holds exactly `size` bytes into `out`. A checksum in the frame is left to the caller's own.
void unzstd(Bytes frame, uint8_t* out, int64_t size);

}  // namespace swz
