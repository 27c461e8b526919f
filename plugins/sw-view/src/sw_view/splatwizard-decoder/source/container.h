// The single file: its header and its sections (docs/bitstream.md, container).
#pragma once
#include "json.h"

namespace swz {

enum Dtype : uint8_t { INT32 = 6, FLOAT32 = 10, FLOAT64 = 11 };  // their codes in a file

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
  // An array section of this dtype and shape, an axis of -1 being none: its values, little-endian.
  Bytes array(const char* name, Dtype dtype, int64_t first, int64_t second = -1, int64_t third = -1);
  const Json* value(const char* key) const;  // of the method; null if it is missing
  bool has(const char* name) const;
  int64_t integer(const char* key, int64_t low, int64_t high) const;
  void usual(const char* part, const char* name) const;  // refuses a file that names anything else for a part
  void allow(int64_t decoded, int64_t gaussians) const;  // refuses what so small a file must not stand for
  void finish() const;                                   // refuses sections that nobody asked for
};

}  // namespace swz
