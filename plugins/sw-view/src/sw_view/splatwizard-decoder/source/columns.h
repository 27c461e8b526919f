// Entropy model `columns`: a matrix of integers, column after column (docs/bitstream.md, columns).
#pragma once
#include "symbols.h"

namespace swz {

struct Plan {
  int64_t kind, parameter, offset, size, first;
  bool differences;
  Buffer<int64_t> dictionary;
};

struct Columns {
  int64_t rows, width;

  // Refuses a matrix of any other size.
  Columns(Bytes data, int64_t rows, int64_t width);

  // The next column, int64 [rows], |value| <= 2^60.
  void next(int64_t* values);
  void finish();  // after the last one

 private:
  Bytes rest, chunks;
  uint64_t crc;
  uint32_t found_crc = 0;
  int64_t column = 0, coded = 0, at_table = 0;
  Buffer<Plan> plans;
  Buffer<int64_t> tables;
  Buffer<int32_t> classes;
  bool begun = false;
  Symbols symbols;
  uint64_t chunk_crc = 0;

  void read_plan(Plan& plan);
  void take_classes(const Plan& plan);
  void join(const Plan& plan, int64_t* values);
};

}  // namespace swz
