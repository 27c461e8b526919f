// What files on a lattice share: the header, and the rows of a packet (docs/bitstream.md, 3dgs, quantized).
#pragma once
#include <initializer_list>

#include "container.h"
#include "model.h"

namespace swz {

struct Layout {
  int64_t count, degree, active, bits, classes, scales;
  double center[3], width[3], top[3];
  double dc_step, rest_step, opacity_step, scale_step, quat_step;
  bool precision;         // rows have classes of it
  const int8_t* basis;    // of SH bands 1 to 3; null: the usual one

  // What the header says; `further` are keys that it may have besides.
  Layout(const Container& file, std::initializer_list<const char*> further = {});
  // Refuses bands that are not there, and no usable grid.
  void check() const;
  int64_t decoded_bytes(int64_t rows) const { return 4 * rows * (8 + scales + 3 * (degree + 1) * (degree + 1)); }
};

[[noreturn]] void wrong(const char* key, const char* reason);
const Json* stated(const Container& file, const char* key);
int64_t stated_integer(const Container& file, const char* key, int64_t low, int64_t high);

constexpr int64_t MAX_SYMBOL = 1 << 30;

// How rows that are coded coarsely become those of the layout. What they lack is there or not: low bits of the
// coordinates, then the columns of the attributes, each of as many integers as there are rows.
struct Coarse {
  int64_t times = 1, raw = 0;
  bool lacking = false;
  Buffer<int16_t> columns;
  mutable int64_t largest = 0;  // of the coarse symbols

  int64_t symbol(int64_t coarse, int64_t column, int64_t row, int64_t rows) const {
    const int64_t size = coarse < 0 ? -coarse : coarse;
    if (size > largest) largest = size;
    return coarse * times + (lacking ? columns[(3 + column) * rows + row] : 0);
  }
  int64_t cell(int64_t coarse, int axis, int64_t row, int64_t rows) const {
    return (coarse << raw) + (lacking ? columns[axis * rows + row] : (int64_t{1} << raw) >> 1);
  }
  // Reads what a section has for so many rows.
  void read(Container& file, const char* section, int64_t rows, int64_t width);
};

// The `layout.count` rows of one packet, whose sections have this prefix; `to` begins with the first of them.
void decode_rows(Container& file, const Layout& layout, const char* prefix, Gaussians to, const Coarse& coarse = {});

}  // namespace swz
