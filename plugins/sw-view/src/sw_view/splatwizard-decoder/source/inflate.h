// One zlib stream whose length both sides know (RFC 1950, RFC 1951).
#pragma once
#include "base.h"

namespace swz {

// Decodes a stream that holds exactly `size` bytes into `out`.
void inflate(Bytes stream, uint8_t* out, int64_t size);

}  // namespace swz
