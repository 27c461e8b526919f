#include "json.h"

#include "decimal.h"

namespace swz {

const Json* Json::find(const char* name) const {
  for (const Json* member = first; member != nullptr; member = member->next)
    if (std::strcmp(member->key, name) == 0) return member;
  return nullptr;
}

namespace {

constexpr int MAX_DEPTH = 32, MAX_STRING = 1 << 16;

template <class... Parts>
[[noreturn]] void unacceptable(Parts... parts) {
  refuse("header is not acceptable JSON: ", parts...);
}

struct Parser {
  const uint8_t *at, *end, *begin;

  [[noreturn]] void wrong() { unacceptable("unexpected byte ", static_cast<int64_t>(at - begin)); }

  void space() {
    while (at < end && (*at == ' ' || *at == '\t' || *at == '\n' || *at == '\r')) ++at;
  }
  bool skip(char expected) {
    space();
    if (at == end || *at != static_cast<uint8_t>(expected)) return false;
    ++at;
    return true;
  }
  void word(const char* text) {
    for (; *text; ++text, ++at)
      if (at == end || *at != static_cast<uint8_t>(*text)) wrong();
  }

  uint32_t four_digits() {
    uint32_t value = 0;
    for (int i = 0; i < 4; ++i, ++at) {
      if (at == end) wrong();
      const uint8_t c = *at, letter = c | 32;
      if (c >= '0' && c <= '9') value = value << 4 | static_cast<uint32_t>(c - '0');
      else if (letter >= 'a' && letter <= 'f') value = value << 4 | static_cast<uint32_t>(letter - 'a' + 10);
      else wrong();
    }
    return value;
  }

  char* escaped(char* to) {
    if (at == end) wrong();
    const uint8_t c = *at++;
    switch (c) {
      case '"': case '\\': case '/': *to++ = static_cast<char>(c); return to;
      case 'b': *to++ = '\b'; return to;
      case 'f': *to++ = '\f'; return to;
      case 'n': *to++ = '\n'; return to;
      case 'r': *to++ = '\r'; return to;
      case 't': *to++ = '\t'; return to;
      case 'u': break;
      default: wrong();
    }
    uint32_t point = four_digits();
    if (point >> 10 == 0xD800 >> 10) {
      if (end - at < 2 || at[0] != '\\' || at[1] != 'u') unacceptable("a string holds a lone surrogate");
      at += 2;
      const uint32_t low = four_digits();
      if (low >> 10 != 0xDC00 >> 10) unacceptable("a string holds a lone surrogate");
      point = 0x10000 + ((point & 1023) << 10 | (low & 1023));
    } else if (point >> 10 == 0xDC00 >> 10) {
      unacceptable("a string holds a lone surrogate");
    }
    const auto put = [&](uint32_t byte) { *to++ = static_cast<char>(byte); };
    if (point < 0x80) put(point);
    else if (point < 0x800) put(0xC0 | point >> 6), put(0x80 | (point & 63));
    else if (point < 0x10000) put(0xE0 | point >> 12), put(0x80 | (point >> 6 & 63)), put(0x80 | (point & 63));
    else put(0xF0 | point >> 18), put(0x80 | (point >> 12 & 63)), put(0x80 | (point >> 6 & 63)), put(0x80 | (point & 63));
    return to;
  }

  // A string, after its opening quote: bytes, and how many.
  const char* string(int32_t& length) {
    const uint8_t* close = at;
    while (close < end && *close != '"') close += *close == '\\' ? 2 : 1;
    if (close >= end) wrong();
    if (close - at > 6 * MAX_STRING) unacceptable("a string is longer than ", grouped(MAX_STRING));
    auto* text = static_cast<char*>(std::malloc(static_cast<size_t>(close - at) + 1));
    if (text == nullptr) unacceptable("no more memory");
    char* to = text;
    while (at < end && *at != '"') {
      if (*at < 32) wrong();
      if (*at == '\\') {
        ++at;
        to = escaped(to);
      } else {
        *to++ = static_cast<char>(*at++);
      }
    }
    if (at == end) wrong();
    ++at;
    *to = 0;
    length = static_cast<int32_t>(to - text);
    if (length > MAX_STRING) unacceptable("a string is longer than ", grouped(MAX_STRING));
    return text;
  }

  void number(Json& value) {
    const uint8_t* start = at;
    const auto digits = [&] {
      const uint8_t* before = at;
      while (at < end && *at >= '0' && *at <= '9') ++at;
      if (at == before) wrong();
      return at - before;
    };
    const bool negative = at < end && *at == '-';
    if (negative) ++at;
    const uint8_t leading = at < end ? *at : 0;
    const int64_t whole = digits();
    if (leading == '0' && whole > 1) wrong();
    value.kind = Json::INTEGER;
    if (at < end && *at == '.') {
      ++at;
      digits();
      value.kind = Json::NUMBER;
    }
    if (at < end && (*at | 32) == 'e') {
      ++at;
      if (at < end && (*at == '+' || *at == '-')) ++at;
      digits();
      value.kind = Json::NUMBER;
    }
    char text[512];
    if (at - start >= int64_t{sizeof(text)}) unacceptable("a number has too many digits");
    std::memcpy(text, start, static_cast<size_t>(at - start));
    text[at - start] = 0;
    value.number = nearest_float64(text);
    if (!__builtin_isfinite(value.number)) unacceptable("a number is not finite");
    if (value.kind == Json::INTEGER) {
      uint64_t found = 0;
      for (const char* digit = text + negative; *digit; ++digit) {
        const auto next = static_cast<uint64_t>(*digit - '0');
        if (found > (uint64_t{INT64_MAX} - next) / 10) unacceptable("an integer does not fit 64 bits");
        found = found * 10 + next;
      }
      value.integer = negative ? -static_cast<int64_t>(found) : static_cast<int64_t>(found);
    }
  }

  Json* value(int depth) {
    space();
    if (at == end) wrong();
    auto* found = static_cast<Json*>(std::malloc(sizeof(Json)));
    if (found == nullptr) unacceptable("no more memory");
    *found = Json{};
    const uint8_t c = *at;
    if (c == '{' || c == '[') {
      if (depth >= MAX_DEPTH) unacceptable("nested deeper than ", MAX_DEPTH, " levels");
      ++at;
      members(*found, c == '{', depth);
    } else if (c == '"') {
      ++at;
      found->kind = Json::STRING;
      found->text = string(found->length);
    } else if (c == 't') {
      word("true");
      found->kind = Json::YES;
    } else if (c == 'f') {
      word("false");
      found->kind = Json::NO;
    } else if (c == 'n') {
      word("null");
    } else {
      number(*found);
    }
    return found;
  }

  void members(Json& of, bool keyed, int depth) {
    of.kind = keyed ? Json::OBJECT : Json::ARRAY;
    const char close = keyed ? '}' : ']';
    if (skip(close)) return;
    Json** last = &of.first;
    do {
      const char* key = "";
      if (keyed) {
        if (!skip('"')) wrong();
        int32_t length = 0;
        key = string(length);
        if (of.length > 4096) unacceptable("an object has too many members");
        if (of.find(key) != nullptr) unacceptable("a key stands twice in one object");
        if (!skip(':')) wrong();
      }
      *last = value(depth + 1);
      (*last)->key = key;
      last = &(*last)->next;
      ++of.length;
    } while (skip(','));
    if (!skip(close)) wrong();
  }
};

}  // namespace

const Json* parse_json(Bytes data) {
  Parser parser{data.data, data.data + data.left, data.data};
  const Json* found = parser.value(0);
  parser.space();
  if (parser.at != parser.end) parser.wrong();
  return found;
}

}  // namespace swz
