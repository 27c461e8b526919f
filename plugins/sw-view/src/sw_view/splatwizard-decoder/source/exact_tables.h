// The shipped integers of the exact mode (docs/bitstream.md, gaussian-exact): the file `exact_tables.bin` of sw-codecs,
// which the host hands in as a zlib stream before it decodes a file that needs it.
#pragma once
#include <kernels.h>

#include "base.h"

namespace swz {

constexpr int64_t TABLE_FILE = 316202;  // bytes
constexpr int CENTRED = 4;              // fraction of tables whose mean is a whole number of steps

// The 512 tables of a density.
struct TableFamily {
  Buffer<int32_t> shares, first, radius;  // as kernels take them
  Buffer<uint16_t> bucket, counts;        // counts less 1, tables back to back without an end
  Buffer<int64_t> first_count;            // [512] where those of a table begin

  void read(Bytes& from);
  splatwizard::Tables tables() const { return {shares.data, first.data, radius.data, bucket.data}; }
};

struct ExactTables {
  uint32_t version, crc;
  uint16_t multipliers[128];
  double scales[64];
  int64_t thresholds[63];
  TableFamily gaussian, laplace;  // the second only where it was asked for

  // Refuses a file that was coded with others.
  void check(int64_t stated_version, int64_t stated_crc) const;
  int64_t multiplier(int64_t output) const {
    const int64_t j = (output + (1 << 15)) >> 9;
    return multipliers[j < 0 ? 0 : j > 127 ? 127 : j];
  }
};

extern Buffer<uint8_t> packed_tables;  // the zlib stream; empty: the host has none

ExactTables exact_tables(bool has_laplace = false);

}  // namespace swz
