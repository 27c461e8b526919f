// The kernels of the exact mode, declared once for every instruction set that they are compiled for. All of them
// compute integers, in whatever order: the results depend on no number of threads and on no instruction set.
#pragma once
#include <cstdint>

#include <splatwizard/dispatch.h>
#include <splatwizard/parallel.h>

namespace splatwizard {

constexpr int64_t STREAM = 1 << 16;  // symbols of a stream
constexpr int64_t SYMBOL_LIMIT = 1 << 30;

// What may be wrong with a file, or with what is to be written.
enum Status : int32_t {
  FINE = 0,
  WORDS_LEFT = 1,      // coded words are left, or the state is not what the encoder began with
  ESCAPES_WRONG = 2,   // escape codes are damaged, too few or too many
  BEYOND_LIMIT = 3,    // a symbol, or the integer part of a mean, is too large
  PARAMETER_WRONG = 4,  // mean, scale or multiplier is out of range
  TOO_FEW = 5           // there are fewer than were announced
};

// The 512 tables of a family as shares of 2^24.
struct Tables {
  const int32_t* shares;   // c_0 .. c_K of each table, back to back
  const int32_t* first;    // [512] where a table's c_0 stands
  const int32_t* radius;   // [512] R: entries stand for -R .. R, and the escape
  const uint16_t* bucket;  // [512, 256] the entry of the smallest number with these leading eight bits
};

// Streams of a payload, one after another: words, then escapes.
struct Streams {
  const uint8_t* data;
  const int64_t* table;   // [count, 3]: what is no business of the kernels, bytes of words, bytes of escapes
  const int64_t* offset;  // [count] where each begins in `data`
  int64_t count;
};

// Where encoded streams go: a place of its own for each, large enough for whatever it may hold.
struct Sinks {
  uint8_t* data;
  const int64_t* offset;  // [count] where each may write; its words and then its escapes
  int64_t* table;         // [count, 3] as above
  int64_t count;
};

// Bytes that a stream of n symbols takes at most: 24 bits a symbol and two words; an escape is below 64 bits.
constexpr int64_t most_bytes(int64_t n) { return 3 * n + 12 + 8 * n + 8; }

struct LatticeArgs {
  const int64_t *mean, *scale, *multiplier;
  int64_t mean_stride, scale_stride, multiplier_stride;  // from row to row
  const uint8_t* present;                                // [rows, columns] or null: all
  const int64_t* start;                                  // [rows] number of the first present number of a row
  int64_t rows, columns;
  const int64_t* thresholds;  // [63]
  int32_t* centre;
  int16_t* number;
};

// The present ones of [rows, columns] numbers.
struct PresentArgs {
  const int32_t* centre;
  const int16_t* number;
  const uint8_t* present;
  const int64_t* start;  // as in LatticeArgs
  int64_t rows, columns;
  int32_t* to_centre;
  int16_t* to_number;
};

// Where decoded symbols go: integers [rows, columns], and their products with a step of each row.
struct PutArgs {
  const int32_t* symbols;
  const uint8_t* present;  // [rows, columns] or null: all
  const int64_t* start;    // as in LatticeArgs
  const double* step;      // [rows]
  int64_t rows, columns;
  float* values;
  int64_t stride;  // of values, from row to row
  int64_t* integers;
};

struct Layer {
  const double* weights;  // [outputs, inputs] integers
  const double* bias;     // [outputs]
  int64_t inputs, outputs;
};

struct NetworkArgs {
  const Layer* layers;
  int64_t depth;
  const int64_t* inputs[2];  // of the first layer, side by side: [rows, width] each
  int64_t width[2], stride[2];
  const int16_t* short_inputs;  // instead [rows, inputs of the first layer], or null
  int64_t rows, leak;           // slope of activations below 0, in 1/4096
};

// Outputs of a network in groups: means, then scales of each; at the end a step of each.
struct ForecastArgs {
  int64_t groups;
  int64_t columns[4];         // of each group
  const int64_t* multipliers;  // [128] 64 .. 16384, by output of the step
  const int64_t* thresholds;   // [63]
  int32_t* centre[4];          // of each group [rows, columns]
  int16_t* number[4];
  int64_t* steps;  // [rows, groups] multipliers
};

struct GridArgs {
  const int64_t* codes;  // [rows, 3]
  int axes[3];
  int dimensions;
  const uint16_t* signs;  // [entries] bit f: sign f is +1
  int features;
  const int64_t *last, *start, *column;  // [levels] R - 1, first entry, first column of the output
  int64_t levels, dense, log2_size, rows;
  int64_t* out;        // [rows, stride]
  int16_t* short_out;  // instead, or null
  int64_t stride;
};

struct TriplaneArgs {
  const int64_t* places;  // [rows, 3] in 0 .. 2^20
  const int32_t* planes[4];  // of each scale [3, R * R, C]
  int64_t size[4];
  int64_t scales, channels, rows;
  int64_t* out;  // [rows, scales * 3 * C]
};

// A stream of some channels of a plane.
struct PlaneStream {
  int64_t scale, orientation, channel, channels;
};

struct PlanesArgs {
  const PlaneStream* streams;
  int64_t count;
  const int64_t *bundle, *bundles_end;  // [bundles + 1] first stream of each bundle, whose streams follow one another
                                        // in the channels of one scale and orientation
  int32_t* planes[4];                   // of each scale [K, C, H, W]
  int64_t channels[4], height[4], width[4];
  const double* weights;  // of each orientation: W [out, in] and b of its five layers
};

}  // namespace splatwizard

#define SW_DECLARE_EXACT(arch)                                                                                      \
  namespace arch {                                                                                                  \
  int32_t lattice(const splatwizard::LatticeArgs&, const splatwizard::Parallel&);                                   \
  void present_rows(const splatwizard::PresentArgs&, const splatwizard::Parallel&);                                 \
  int32_t decode_streams(const splatwizard::Tables&, const splatwizard::Streams&, const int32_t* centre,            \
                         const int16_t* number, int64_t count, int32_t* symbols, const splatwizard::Parallel&);     \
  int32_t encode_streams(const splatwizard::Tables&, const splatwizard::Sinks&, const int32_t* centre,              \
                         const int16_t* number, int64_t count, const int32_t* symbols, const splatwizard::Parallel&); \
  void put_values(const splatwizard::PutArgs&, const splatwizard::Parallel&);                                       \
  void network(const splatwizard::NetworkArgs&, int64_t* out, const splatwizard::Parallel&);                        \
  int32_t forecast(const splatwizard::NetworkArgs&, const splatwizard::ForecastArgs&,                               \
                   const splatwizard::Parallel&);                                                                   \
  void grid_features(const splatwizard::GridArgs&, const splatwizard::Parallel&);                                   \
  void triplane_features(const splatwizard::TriplaneArgs&, const splatwizard::Parallel&);                           \
  int32_t decode_planes(const splatwizard::Tables&, const splatwizard::Streams&, const splatwizard::PlanesArgs&,    \
                        const splatwizard::Parallel&);                                                              \
  int32_t encode_planes(const splatwizard::Tables&, const splatwizard::Sinks&, const splatwizard::PlanesArgs&,      \
                        const splatwizard::Parallel&);                                                              \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_EXACT)
