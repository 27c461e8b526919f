// The single file: its header and its sections (docs/bitstream.md, container).
#pragma once
#include "json.h"

namespace swz {

enum Dtype : uint8_t { INT32 = 6, FLOAT16 = 9, FLOAT32 = 10, FLOAT64 = 11 };  // their codes in a file

constexpr int64_t FREE = 1 << 24, EXPANSION = 256;  // bytes of a model: always, and for each byte of its sections

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
  int64_t cuts = 0, packets = 0;  // declared, and read of them; of a file without cuts 0
  bool is_first_part = false;     // more was there than was asked for

  // Reads the first packets of a file with cuts, `asked` of them; 0: all that are there.
  Container(Bytes file, int64_t asked);

  Bytes section(const char* name);  // refuses the file if it has none of that name
  // An array section of this dtype and shape, an axis of -1 being none: its values, little-endian.
  Bytes array(const char* name, Dtype dtype, int64_t first, int64_t second = -1, int64_t third = -1);
  const Json* value(const char* key) const;  // of the method; null if it is missing
  bool has(const char* name) const;
  int64_t integer(const char* key, int64_t low, int64_t high) const;
  void usual(const char* part, const char* name) const;  // refuses a file that names anything else for a part
  // Refuses what so small a file must not stand for, which `parts` name.
  template <class... Parts>
  void allow_what(int64_t decoded, Parts... parts) const {
    const int64_t most = FREE + EXPANSION * payload;
    if (decoded > most)
      refuse("claims ", parts..., " of ", grouped(decoded), " bytes in memory, a file of ", grouped(payload),
             " may stand for at most ", grouped(most));
  }
  void allow(int64_t decoded, int64_t gaussians) const {
    allow_what(decoded, "a model of ", grouped(gaussians), " Gaussians");
  }
  void finish() const;                                   // refuses sections that nobody asked for

 private:
  void read_rows(const Json* table);
  int64_t choose_cut(const Json* rows, int64_t length, int64_t header_bytes, int64_t asked);  // sections that are read
  void read_sections(const Json* table, Bytes file, int64_t wanted);
};

}  // namespace swz
