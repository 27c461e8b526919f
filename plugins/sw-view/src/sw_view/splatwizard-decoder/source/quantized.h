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

// The `layout.count` rows of one packet, whose sections have this prefix; `to` begins with the first of them.
void decode_rows(Container& file, const Layout& layout, const char* prefix, Gaussians to);

}  // namespace swz
