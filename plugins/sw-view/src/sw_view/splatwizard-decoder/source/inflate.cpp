#include "inflate.h"

namespace swz {

namespace {

[[noreturn]] void damaged(const char* what) { refuse("not a zlib stream: Error -3 while decompressing data: ", what); }

[[noreturn]] void another_size(int64_t size) {
  refuse("the zlib stream does not hold exactly ", grouped(size), " bytes");
}

struct Codes {
  uint16_t count[16] = {}, symbol[288];

  // Of symbols by their lengths in bits, 0 for those that do not occur.
  Codes(const uint8_t* lengths, int symbols) {
    uint16_t offset[16] = {};
    for (int s = 0; s < symbols; ++s) ++count[lengths[s]];
    count[0] = 0;
    int left = 1;
    for (int length = 1; length < 16; ++length) {
      left = 2 * left - count[length];
      if (left < 0) damaged("invalid code lengths set");
      if (length < 15) offset[length + 1] = static_cast<uint16_t>(offset[length] + count[length]);
    }
    for (int s = 0; s < symbols; ++s)
      if (lengths[s]) symbol[offset[lengths[s]]++] = static_cast<uint16_t>(s);
  }
};

struct Inflater {
  Bytes from;
  uint8_t *begin, *at, *end;
  uint32_t held = 0;
  int bits = 0;

  uint32_t take(int count) {
    while (bits < count) {
      if (from.left == 0) another_size(end - begin);
      held |= static_cast<uint32_t>(from.integer(1)) << bits;
      bits += 8;
    }
    const uint32_t value = held & ((1u << count) - 1);
    held >>= count, bits -= count;
    return value;
  }

  int symbol(const Codes& codes) {
    int code = 0, first = 0, index = 0;
    for (int length = 1; length < 16; ++length) {
      code |= static_cast<int>(take(1));
      const int count = codes.count[length];
      if (code - count < first) return codes.symbol[index + code - first];
      index += count, first = (first + count) << 1, code <<= 1;
    }
    damaged("invalid code");
  }

  void stored() {
    held = 0, bits = 0;
    if (from.left < 4) another_size(end - begin);
    const uint64_t length = from.integer(2), inverse = from.integer(2);
    if ((length ^ 0xFFFF) != inverse) damaged("invalid stored block lengths");
    if (static_cast<int64_t>(length) > end - at || static_cast<int64_t>(length) > from.left) another_size(end - begin);
    const Bytes plain = from.take(static_cast<int64_t>(length));
    std::memcpy(at, plain.data, static_cast<size_t>(length));
    at += length;
  }

  void coded(const Codes& literals, const Codes& distances) {
    static constexpr uint16_t LENGTH[29] = {3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258};
    static constexpr uint8_t LENGTH_BITS[29] = {0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0};
    for (;;) {
      const int found = symbol(literals);
      if (found < 256) {
        if (at == end) another_size(end - begin);
        *at++ = static_cast<uint8_t>(found);
        continue;
      }
      if (found == 256) return;
      if (found > 285) damaged("invalid literal/length code");
      const int64_t length = LENGTH[found - 257] + take(LENGTH_BITS[found - 257]);
      const int code = symbol(distances);
      if (code > 29) damaged("invalid distance code");
      const int extra = code < 4 ? 0 : code / 2 - 1;
      const int64_t back = (code < 4 ? code + 1 : ((2 + code % 2) << extra) + 1) + static_cast<int64_t>(take(extra));
      if (back > at - begin) damaged("invalid distance too far back");
      if (length > end - at) another_size(end - begin);
      for (int64_t i = 0; i < length; ++i, ++at) *at = at[-back];
    }
  }

  void described() {
    static constexpr uint8_t ORDER[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
    const int literals = static_cast<int>(take(5)) + 257, distances = static_cast<int>(take(5)) + 1;
    const int described = static_cast<int>(take(4)) + 4;
    uint8_t lengths[320] = {};
    for (int i = 0; i < described; ++i) lengths[ORDER[i]] = static_cast<uint8_t>(take(3));
    const Codes codes(lengths, 19);
    for (int i = 0; i < literals + distances;) {
      const int found = symbol(codes);
      if (found < 16) {
        lengths[i++] = static_cast<uint8_t>(found);
        continue;
      }
      if (found == 16 && i == 0) damaged("invalid bit length repeat");
      const uint8_t value = found == 16 ? lengths[i - 1] : 0;
      int times = found == 16 ? 3 + static_cast<int>(take(2)) : found == 17 ? 3 + static_cast<int>(take(3)) : 11 + static_cast<int>(take(7));
      if (i + times > literals + distances) damaged("invalid bit length repeat");
      while (times--) lengths[i++] = value;
    }
    if (lengths[256] == 0 || literals > 286) damaged("invalid code -- missing end-of-block");
    coded(Codes(lengths, literals), Codes(lengths + literals, distances));
  }

  void usual() {
    uint8_t lengths[288], distances[30];
    for (int s = 0; s < 288; ++s) lengths[s] = s < 144 ? 8 : s < 256 ? 9 : s < 280 ? 7 : 8;
    std::memset(distances, 5, sizeof(distances));
    coded(Codes(lengths, 288), Codes(distances, 30));
  }
};

uint32_t adler(const uint8_t* data, int64_t size) {
  uint32_t a = 1, b = 0;
  for (int64_t i = 0; i < size; ++i) {
    a = (a + data[i]) % 65521;
    b = (b + a) % 65521;
  }
  return b << 16 | a;
}

}  // namespace

void inflate(Bytes stream, uint8_t* out, int64_t size) {
  if (stream.left < 2) another_size(size);
  const uint64_t method = stream.integer(1), flags = stream.integer(1);
  if ((method & 15) != 8 || method >> 4 > 7 || (flags & 32) || (method << 8 | flags) % 31) damaged("incorrect header check");
  Inflater inflater{stream, out, out, out + size};
  bool last = false;
  while (!last) {
    last = inflater.take(1);
    switch (inflater.take(2)) {
      case 0: inflater.stored(); break;
      case 1: inflater.usual(); break;
      case 2: inflater.described(); break;
      default: damaged("invalid block type");
    }
  }
  if (inflater.from.left != 4 || inflater.at != inflater.end) another_size(size);
  const Bytes sum = inflater.from.take(4);
  const uint32_t expected = uint32_t{sum.data[0]} << 24 | uint32_t{sum.data[1]} << 16 | uint32_t{sum.data[2]} << 8 | sum.data[3];
  if (adler(out, size) != expected) damaged("incorrect data check");
}

}  // namespace swz
