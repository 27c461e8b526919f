#include "exact_tables.h"

#include "inflate.h"

namespace swz {

Buffer<uint8_t> packed_tables;

namespace {

constexpr int LEVELS = 64, FRACTIONS = 8, TABLES = LEVELS * FRACTIONS, STEPS = 128, PREFIX = 10, VERSION = 1;
constexpr int64_t TOTAL = 1 << 24;

// Shares of a table of counts as a model (docs/bitstream.md, tables of counts as models), and its buckets.
void put_table(const uint16_t* less, int64_t entries, int32_t* shares, uint16_t* bucket) {
  double sum = 0;
  for (int64_t i = 0; i < entries; ++i) sum += less[i] + 1.0;
  const double factor = static_cast<double>(TOTAL - entries) / sum;
  double before = 0;
  for (int64_t i = 0; i < entries; ++i) {
    shares[i] = static_cast<int32_t>(static_cast<int64_t>(before * factor) + i);
    before += less[i] + 1.0;
  }
  shares[entries] = TOTAL;
  int64_t entry = 0;
  for (int64_t i = 0; i < 256; ++i) {
    while (shares[entry + 1] <= i << 16) ++entry;
    bucket[i] = static_cast<uint16_t>(entry);
  }
}

void put_hexadecimal(Text& text, uint32_t value) {
  char digits[9] = {};
  for (int i = 0; i < 8; ++i) digits[i] = "0123456789abcdef"[value >> (28 - 4 * i) & 15];
  text.put(digits);
}

}  // namespace

void ExactTables::check(int64_t stated_version, int64_t stated_crc) const {
  if (stated_version == version && stated_crc == crc) return;
  Text stated, mine;
  put_hexadecimal(stated, static_cast<uint32_t>(stated_crc));
  put_hexadecimal(mine, crc);
  refuse("coded with exact tables ", stated_version, " (", stated.data, "), installed are ", int64_t{version}, " (",
         mine.data, "): install the sw-codecs version that wrote the file");
}

void TableFamily::read(Bytes& from) {
  radius = Buffer<int32_t>(TABLES);
  int64_t entries = 0;
  for (int i = 0; i < LEVELS; ++i) {
    const auto own = static_cast<int32_t>(from.integer(2));
    for (int f = 0; f < FRACTIONS; ++f) radius[FRACTIONS * i + f] = own;
    entries += FRACTIONS * (2 * own + 2);
  }
  counts = Buffer<uint16_t>(entries);
  std::memcpy(counts.data, from.take(2 * entries).data, static_cast<size_t>(2 * entries));
  shares = Buffer<int32_t>(entries + TABLES);
  first = Buffer<int32_t>(TABLES);
  first_count = Buffer<int64_t>(TABLES);
  bucket = Buffer<uint16_t>(256 * TABLES);
  for (int64_t i = 0, at = 0; i < TABLES; ++i) {
    const int64_t size = 2 * radius[i] + 2;
    first[i] = static_cast<int32_t>(at + i);
    first_count[i] = at;
    put_table(counts.data + at, size, shares.data + first[i], bucket.data + 256 * i);
    at += size;
  }
}

ExactTables exact_tables(bool has_laplace) {
  const Blame blame(nullptr);
  if (packed_tables.size == 0) refuse("the decoder was not given its tables");
  Buffer<uint8_t> file(TABLE_FILE);
  inflate(Bytes{packed_tables.data, packed_tables.size}, file.data, file.size);
  Bytes from{file.data, file.size};
  from.left -= 4;
  Bytes end{file.data + from.left, 4};
  ExactTables found;
  found.crc = static_cast<uint32_t>(end.integer(4));
  if (crc32(file.data, from.left) != found.crc || std::memcmp(from.take(4).data, "SPWT", 4) != 0)
    refuse("the exact tables of the decoder are damaged");
  found.version = static_cast<uint32_t>(from.integer(2));
  from.take(PREFIX - 6);
  if (found.version != VERSION) refuse("the exact tables of the decoder are damaged");
  for (auto& each : found.multipliers) each = static_cast<uint16_t>(from.integer(2));
  for (auto& each : found.scales) each = static_cast<double>(from.integer(4)) / (1 << 20);
  for (auto& each : found.thresholds) each = static_cast<int64_t>(from.integer(4));
  found.gaussian.read(from);
  if (has_laplace) found.laplace.read(from);
  return found;
}

}  // namespace swz
