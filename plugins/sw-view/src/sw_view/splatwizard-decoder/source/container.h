// The single file: its header and its sections (docs/bitstream.md, container).
#pragma once
#include "json.h"

namespace swz {

struct Section {
  const char* name;
  Bytes content;
  bool read;
};

struct Container {
  const Json *method = nullptr, *header = nullptr;
  int64_t version = 0;  // of the layout of the method
  Section* sections = nullptr;
  int64_t count = 0, payload = 0;

  explicit Container(Bytes file);

  Bytes section(const char* name);  // refuses the file if it has none of that name
  // An array section of float32 and this shape, an axis of -1 being none: its values, little-endian.
  Bytes array(const char* name, int64_t first, int64_t second = -1, int64_t third = -1);
  const Json* value(const char* key) const;  // of the method; null if it is missing
  int64_t integer(const char* key, int64_t low, int64_t high) const;
  void allow(int64_t decoded, int64_t gaussians) const;  // refuses what so small a file must not stand for
  void finish() const;                                   // refuses sections that nobody asked for
};

}  // namespace swz
