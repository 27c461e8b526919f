// Splats of wisp (docs/bitstream.md, wisp): what all parts of their decoder share.
#pragma once
#include "eight_bits.h"
#include "exact_tables.h"

namespace swz {

constexpr int64_t NUMBERS = 22, UNIT = 4096, VALUE_LIMIT = 1 << 20, HIGHEST_SCALE = 63 * UNIT;
constexpr int64_t LOWEST_LEVEL = 3, HIGHEST_LEVEL = 18;

// Columns of the 22 numbers, from `first` to below `end`.
struct Span {
  int64_t first, end;
  int64_t width() const { return end - first; }
};
constexpr Span BASE{0, 10}, REFINED{1, 10}, LATENTS{10, 22};
// What is predicted at once, and the pieces of it that are coded at once.
constexpr Span BLOCKS[4] = {{0, 1}, {1, 7}, {7, 10}, {10, 22}};
constexpr Span PIECES[4][3] = {{{0, 1}}, {{1, 4}, {4, 7}}, {{7, 8}, {8, 9}, {9, 10}}, {{10, 14}, {14, 18}, {18, 22}}};
constexpr int PIECES_OF[4] = {1, 2, 3, 3};

// Some rows of the splats, evenly apart.
struct Rows {
  int64_t first, step, count;
  int64_t operator[](int64_t i) const { return first + step * i; }
  Rows part(int64_t begin, int64_t most) const {
    return {(*this)[begin], step, count - begin < most ? count - begin : most};
  }
};

// Integers of the splats known so far, in the order of the file; [most, 22] each.
struct Splats {
  int64_t count = 0, most;
  Buffer<int64_t> levels, codes;  // Morton codes of cells at the level of each
  Buffer<int32_t> mean, scale, multiplier, index;
  Buffer<int8_t> missing;   // refinements
  Buffer<uint8_t> has_view;

  explicit Splats(int64_t rows);
  void make_room(int64_t rows);
  int64_t unit(int64_t row, int64_t column) const {
    const int64_t at = NUMBERS * row + column;
    return mean[at] + int64_t{index[at]} * multiplier[at];
  }
};

// t of the tables of the Gaussian; `planes`: how often the step was tripled.
inline int64_t table_of(int64_t scale, int64_t planes) {
  const int64_t t = (scale - 39624 * planes + UNIT / 2) >> 12;
  return t < 0 ? 0 : t > 63 ? 63 : t;
}

inline int64_t clamped(int64_t value, int64_t low, int64_t high) { return value < low ? low : value > high ? high : value; }

// Distributions of a block of some rows, [rows, width] each.
struct Prediction {
  Buffer<int64_t> mean, scale;
  Buffer<int32_t> multiplier;

  Prediction(int64_t rows, int64_t width) : mean(rows * width), scale(rows * width), multiplier(rows * width) {}
};

// What predicts numbers from the splats before them.
struct Context {
  int base_parts, later_parts;  // of the packets of the first subset, and of others

  // Goes before `predict` for some of these rows, after whatever changes what is known.
  virtual void look(Rows, const Splats&) {}
  virtual void predict(int block, Rows rows, const Splats& splats, Prediction& to) = 0;
  // What the pieces before `piece` of a block add to the mean and scale of its numbers, in one row.
  virtual void tie(int block, int piece, int64_t row, const Splats& splats, int64_t* mean, int64_t* scale) const = 0;
  // Numbers became known.
  virtual void learn(Span columns, Rows rows, const Splats& splats) = 0;
  // Refined numbers became finer than `before` [rows, 9].
  virtual void refine(Rows rows, const int64_t* before, const Splats& splats) = 0;
  virtual void forget() {}  // gives back its memory: nothing is asked any more

 protected:
  ~Context() = default;
};

// The context of a section `networks`, which stays as long as the instance.
Context& read_statistics(Bytes& from);
Context& read_pyramid(Bytes& from, const ExactTables& tables);

// What makes Gaussians of integers.
struct Appearance {
  int64_t planes, sh_degree;
  double low[3], edge, base_steps[NUMBERS];
  uint8_t strengths[3][5];  // of the pull towards centroids, by missing refinements and group
  EightBitLayer basis, hidden, last;
};

// `has_base`: Gaussians of the same base were put before, and get their new harmonics.
void put_gaussians(const Splats& splats, const Appearance& looks, const ExactTables& tables, bool has_base);

}  // namespace swz
