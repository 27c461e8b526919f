// Chunks of symbols as the entropy coders frame them (docs/bitstream.md, entropy coders).
#pragma once
#include "symbols.h"

namespace swz {

constexpr int64_t CHUNK = 1 << 20;

// What stands before the payload of a chunk.
struct ChunkHead {
  int64_t low, high, length;  // the smallest and the largest symbol; bytes of the payload
  uint64_t crc;

  // Refuses a chunk of another number of symbols.
  ChunkHead(Bytes& from, int64_t wanted) {
    const auto number = static_cast<int64_t>(from.integer(4));
    low = static_cast<int32_t>(from.integer(4));
    high = static_cast<int32_t>(from.integer(4));
    length = static_cast<int64_t>(from.integer(4));
    crc = from.integer(4);
    if (number != wanted) refuse("a chunk has ", grouped(number), " symbols, expected ", grouped(wanted));
  }
};

// Symbols 0 .. highest; take(payload, symbols, how many) decodes a chunk that does not repeat one symbol.
template <class Take>
void read_chunks(Bytes& data, int64_t count, int64_t highest, int32_t* symbols, const Take& take) {
  constexpr int64_t HEADER = 20;
  if (data.left < HEADER * ((count + CHUNK - 1) / CHUNK))
    refuse(grouped(data.left), " bytes cannot hold ", grouped(count), " symbols: truncated data or a wrong number");
  for (; count > 0; count -= CHUNK, symbols += CHUNK) {
    const int64_t wanted = count < CHUNK ? count : CHUNK;
    const ChunkHead head(data, wanted);
    if (head.low < 0 || head.high < head.low || head.high > highest)
      refuse("a chunk has symbols ", head.low, "..", head.high, ", the model's domain is 0..", highest);
    const Bytes payload = data.take(head.length);
    int32_t least = INT32_MAX, most = 0;
    if (head.low == head.high) {
      if (payload.left) refuse("a chunk of one repeated symbol has a payload");
      for (int64_t i = 0; i < wanted; ++i) symbols[i] = static_cast<int32_t>(head.low);
    } else {
      take(payload, symbols, wanted);
    }
    for (int64_t i = 0; i < wanted; ++i) {
      least = symbols[i] < least ? symbols[i] : least;
      most = symbols[i] > most ? symbols[i] : most;
    }
    if (crc32(symbols, 4 * wanted) != head.crc || least != head.low || most != head.high) refuse(CRC_DIFFERS);
  }
  data.finish();
}

}  // namespace swz
