// Strict JSON, as headers use it (docs/bitstream.md, header).
#pragma once
#include "base.h"

namespace swz {

struct Json {
  enum Kind : uint8_t { NOTHING, NO, YES, INTEGER, NUMBER, STRING, ARRAY, OBJECT };
  Kind kind = NOTHING;
  int32_t length = 0;         // of a string in bytes; members of an array or object
  int64_t integer = 0;
  double number = 0;          // of an integer too
  const char* text = "";      // of a string, ends with 0
  const char* key = "";       // in an object
  Json *first = nullptr, *next = nullptr;

  bool is_number() const { return kind == INTEGER || kind == NUMBER; }
  bool is(const char* other) const { return kind == STRING && std::strcmp(text, other) == 0; }
  const Json* find(const char* name) const;  // the member of an object, or null
};

// The value in `data`, in memory that is never released. Refuses anything else than strict JSON.
const Json* parse_json(Bytes data);

}  // namespace swz
