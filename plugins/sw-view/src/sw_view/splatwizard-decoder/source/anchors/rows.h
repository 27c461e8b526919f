// Rows of integers under predicted distributions (docs/bitstream.md, gaussian-exact, conditional-gaussian and
// conditional-mixture), and bits under one share of ones.
#pragma once
#include "exact_tables.h"

namespace swz {

// A block of rows; `present` [rows, columns] says which numbers are in the file, null: all.
struct Block {
  int64_t rows, columns;
  const uint8_t* present = nullptr;
};

// [rows, columns] int64, `stride` from row to row.
struct Integers {
  const int64_t* data;
  int64_t stride;
};

// Where decoded numbers go: their products with a step of each row, and if `integers` is set with a multiplier.
struct Destination {
  float* values;
  int64_t stride;
  const double* step;         // [rows]
  const int64_t* multiplier;  // [rows]
  int64_t* integers = nullptr;
  int64_t integers_stride = 0;
};

struct Mixture {
  Integers mean[2], scale[2], logit;
};

struct RowDecoder {
  const ExactTables& tables;
  Buffer<double> below, escape;  // of the tables, as kernels of mixtures take them
  Buffer<int32_t> first_below;

  explicit RowDecoder(const ExactTables& exact) : tables(exact) {}

  void gaussians(Bytes data, const Block& block, Integers mean, Integers scale, const Destination& to);
  void mixtures(Bytes data, const Block& block, const Mixture& of, const Destination& to);

 private:
  void streams(Bytes data, const int32_t* centre, const int16_t* number, int64_t count, int32_t* symbols) const;
  void version_1(Bytes data, const int32_t* centre, const int16_t* number, int64_t count, int32_t* symbols) const;
  void sum_tables();
};

// Where streams of rANS words and escapes lie in `data`, which they must fill.
struct StreamTable {
  Buffer<int64_t> sizes, offsets;  // [count, 3] CRC-32 or 0, bytes of words, bytes of escapes; [count]
  Bytes data;

  StreamTable(Bytes& from, int64_t count, bool has_crc);
};

constexpr char WRONG_CONTEXT[] = "the decoded symbols do not match their CRC-32: damaged data or a wrong context";

// Refuses what a kernel found; 0: all is well.
void refuse_damage(int32_t status);

// Bits 0 and 1 by `bernoulli`.
void bernoulli(Bytes data, int64_t count, int32_t* bits);

}  // namespace swz
