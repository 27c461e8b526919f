// Integer planes under spatial models (docs/bitstream.md, planes under spatial models), and what they give at a place.
#pragma once
#include "rows.h"
#include "networks.h"

namespace swz {

constexpr int ORIENTATIONS = 3;
constexpr int64_t MOST_SCALES = 4;

// A spatial model in integers.
struct SpatialModel {
  static constexpr int64_t NEIGHBORS = 12, HIDDEN = 16, LAYERS = 5;
  static constexpr int64_t NUMBERS =
      HIDDEN * (NEIGHBORS + 1) + 3 * HIDDEN * (HIDDEN + 1) + 2 * (HIDDEN + 1);
  IntegerNetwork network;

  void take(Weights& weights);  // off the front
  void convert();

 private:
  Buffer<float> numbers;
};

struct Planes {
  int64_t scales = 0, channels = 0;
  int64_t size[MOST_SCALES];           // rows and columns
  Buffer<int32_t> values[MOST_SCALES];  // [3, size * size, channels]

  int64_t integers() const;  // of all scales
  void decode(Bytes data, const SpatialModel* models, const ExactTables& tables);
  // [rows, 3 channels scales] at places [rows, 3], with 12 fractional bits.
  void features(const int64_t* places, int64_t rows, int64_t* to) const;

 private:
  void decode_streams(Bytes data, const SpatialModel* models, const ExactTables& tables);
  void decode_version_1(Bytes data, const SpatialModel* models, const ExactTables& tables);
};

}  // namespace swz
