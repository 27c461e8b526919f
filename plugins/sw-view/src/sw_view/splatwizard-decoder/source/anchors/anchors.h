// What the files of anchor methods share: sizes, positions, masks, networks, and the order of what is decoded
// (docs/bitstream.md, hac).
#pragma once
#include "container.h"
#include "networks.h"
#include "rows.h"

namespace swz {

constexpr int GROUPS = 3;  // features, scales, offsets
constexpr int64_t MOST_LIST = 64;

// A list of integers of the header.
struct IntegerList {
  int64_t values[MOST_LIST];
  int64_t count = 0, sum = 0;

  IntegerList() = default;
  IntegerList(const Container& file, const char* key, int64_t low, int64_t high, int64_t longest, int64_t shortest = 1);
  int64_t operator[](int64_t i) const { return values[i]; }
};

// Numbers per anchor in its groups.
struct Shape {
  int64_t features, offsets;

  int64_t width(int group) const { return group == 0 ? features : group == 1 ? 6 : 3 * offsets; }
  int64_t all() const { return features + 6 + 3 * offsets; }
  int64_t widest() const {
    const int64_t most = features > 3 * offsets ? features : 3 * offsets;
    return most > 6 ? most : 6;
  }
  int64_t outputs() const { return 2 * all() + GROUPS; }  // of a context network
  int64_t decoded_bytes() const { return 4 * (3 + all()) + offsets; }
};

// Refuses the mode `float`, whose files decode on one machine alone.
void check_mode(const Container& file);
void read_base_steps(const Container& file, double low, double high, const char* range, double* steps);

// Positions and masks.
struct Geometry {
  int64_t count = 0, offsets = 0, gaussians = 0;
  double low[3], step[3];   // of the lattice of the codes
  Buffer<int64_t> codes;    // [count, 3], 16 bits
  Buffer<float> positions;  // [count, 3]
  Buffer<uint8_t> masks;    // [count, 3 offsets], a byte for each coordinate of an offset

  void read_counts(const Container& file, const Shape& shape);
  void read_bounds(Bytes& data);
  void read_anchors(Bytes data);  // as multiples of the lattice's step
  void read_voxels(Bytes data);   // as multiples of a voxel
  void read_masks(Container& file);
  int64_t code_of(float position, int axis) const;
};

// The decoded arrays, empty, in the order of their names.
struct DecodedAnchors {
  static constexpr const char* NETWORKS[3] = {"mlp_opacity", "mlp_cov", "mlp_color"};  // in the order of a file
  float *features = nullptr, *scales = nullptr, *offsets = nullptr;

  DecodedAnchors() = default;
  // Takes the three networks off the front of the weights.
  DecodedAnchors(const Geometry& geometry, const Shape& shape, int64_t hidden, Weights& weights);

  float* group(int of) const { return of == 0 ? features : of == 1 ? scales : offsets; }
};


int64_t networks_of_anchors(const Shape& shape, int64_t hidden);  // numbers of these three

// Factors of the outputs of a context network, [shape.outputs()]: means and scales come in base steps.
void put_units(const Shape& shape, const double* base_steps, double* units);

const char* joined(const char* first, const char* second);
const char* numbered(const char* name, int64_t number);  // name and digits

// A section as blocks.
struct Blocks {
  const char* name;
  Bytes left;
};

// Coded groups of blocks of rows.
struct AttributeDecoder {
  Container& file;
  const Geometry& geometry;
  const Shape shape;
  const double* base_steps;
  const DecodedAnchors& to;
  RowDecoder rows;
  Blocks sections[MOST_LIST + 2];
  int64_t count = 0;
  Buffer<double> step[GROUPS];          // of the block at hand
  Buffer<int64_t> multiplier[GROUPS];

  AttributeDecoder(Container& container, const Geometry& places, const Shape& sizes, const double* steps,
                   const ExactTables& tables, const DecodedAnchors& anchors)
      : file(container), geometry(places), shape(sizes), base_steps(steps), to(anchors), rows(tables) {}

  void add(const char* name) { sections[count++] = {name, file.section(name)}; }
  // Rows of a block.
  int64_t block_rows() const {
    const int64_t rows_of = (1 << 20) / shape.widest();
    return rows_of > 1 ? rows_of : 1;
  }
  // Multipliers of a block, by a network's step outputs, which stand `stride` apart.
  void begin(int64_t n, const int64_t* outputs, int64_t stride, int64_t offset);
  Destination destination(int group, int64_t first, int64_t column) const;
  // Decodes columns of a group, with the means and scales given.
  void gaussians(int section, int group, int64_t first, int64_t n, int64_t column, int64_t columns, Integers mean,
                 Integers scale, int64_t* integers = nullptr, int64_t integers_stride = 0);
  void mixtures(int section, int64_t first, int64_t n, int64_t column, int64_t columns, const Mixture& of,
                int64_t* integers, int64_t integers_stride);
  void finish() const;
};

}  // namespace swz
