#include "container.h"

namespace swz {

namespace {

constexpr int64_t PREFIX = 10, MAX_HEADER = 1 << 19, MAX_SECTIONS = 4096, FREE = 1 << 24, EXPANSION = 256;

bool is_letter_or_digit(char c) {
  return (c >= '0' && c <= '9') || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z');
}

// Whether a text is a name of at most 64 of the allowed characters.
bool is_name(const Json& text, const char* others) {
  if (text.kind != Json::STRING || text.length < 1 || text.length > 64) return false;
  for (int i = 0; i < text.length; ++i) {
    const char c = text.text[i];
    if (is_letter_or_digit(c) || c == '_') continue;
    if (i == 0 || c == 0 || std::strchr(others, c) == nullptr) return false;
  }
  return true;
}

const Json* member(const Json* header, const char* key, Json::Kind kind, const char* type) {
  const Json* found = header->find(key);
  if (found->kind != kind) refuse("header value '", key, "' is not of type ", type);
  return found;
}

const Json* read_header(Bytes& file) {
  const int64_t size = file.left;
  if (size == 0) refuse("the file is empty");
  if (std::memcmp(file.data, "SPWZ", size < 4 ? static_cast<size_t>(size) : 4) != 0)
    refuse("not a .swz file (it does not start with SPWZ)");
  if (size < PREFIX) refuse(size, " bytes are too few for a .swz file: it is truncated");
  file.take(4);
  const auto version = static_cast<int64_t>(file.integer(2)), length = static_cast<int64_t>(file.integer(4));
  if (version < 1) refuse("container version ", version, " does not exist: the file is damaged");
  if (length > MAX_HEADER)
    refuse("header of ", grouped(length), " bytes, at most ", grouped(MAX_HEADER), " are allowed");
  if (version > 1)
    refuse("container version ", version, " is newer than 1, the newest that this installation reads");
  const int64_t start = PREFIX + length + 4;
  if (size < start)
    refuse("the file ends inside its header (", grouped(size), " of ", grouped(start), " bytes): it is truncated");
  const Bytes raw = file.take(length);
  if (crc32(raw.data, raw.left) != file.integer(4))
    refuse("the CRC-32 of the header does not match: the file is damaged");
  const Json* header = parse_json(raw);
  const char* keys[] = {"method", "method_version", "raster", "static", "sections"};
  bool exact = header->kind == Json::OBJECT && header->length == 5 + (header->find("requires") != nullptr);
  for (int i = 0; exact && i < 5; ++i) exact = header->find(keys[i]) != nullptr;
  if (!exact)
    refuse("header must hold exactly method, method_version, raster, static, sections, and it may hold requires");
  return header;
}

}  // namespace

Container::Container(Bytes file) {
  header = read_header(file);
  method = member(header, "method", Json::STRING, "str");
  version = member(header, "method_version", Json::INTEGER, "int")->integer;
  member(header, "raster", Json::OBJECT, "dict");
  member(header, "static", Json::OBJECT, "dict");
  const Json* table = member(header, "sections", Json::ARRAY, "list");
  if (!is_name(*method, ".-") || version < 0 || version > INT32_MAX) refuse("header names no valid method and version");
  if (table->length > MAX_SECTIONS)
    refuse(grouped(table->length), " sections, at most ", MAX_SECTIONS, " are allowed");
  sections = static_cast<Section*>(std::malloc(sizeof(Section) * static_cast<size_t>(table->length + 1)));
  payload = file.left;
  int64_t position = 0;
  for (const Json* row = table->first; row != nullptr; row = row->next) {
    if (row->kind != Json::ARRAY || row->length != 4 || row->first->kind != Json::STRING)
      refuse("a row of the section table is not [name, offset, length, crc32]");
    const Json* name = row->first;
    bool usable = is_name(*name, "./-") && !name->is("header");
    for (int64_t i = 0; usable && i < count; ++i) usable = !name->is(sections[i].name);
    if (!usable) refuse("section name '", name->text, "' is malformed or appears twice");
    const Json *offset = name->next, *length = offset->next, *crc = length->next;
    const Blame blame(name->text);
    for (const Json* number : {offset, length, crc})
      if (number->kind != Json::INTEGER || number->integer < 0 || offset->integer != position)
        refuse("offset, length or crc32 make no sense in the section table");
    if (length->integer > file.left)
      refuse("is ", grouped(file.left), " bytes, header says ", grouped(length->integer), ": the file is truncated");
    const Bytes content = file.take(length->integer);
    if (crc32(content.data, content.left) != crc->integer) refuse("its CRC-32 does not match: the file is damaged");
    sections[count++] = {name->text, content, false};
    position += content.left;
  }
  if (file.left) refuse(grouped(file.left), " bytes follow the last section: the file is damaged");
}

Bytes Container::section(const char* name) {
  for (int64_t i = 0; i < count; ++i)
    if (std::strcmp(sections[i].name, name) == 0) {
      sections[i].read = true;
      return sections[i].content;
    }
  const Blame blame(name);
  refuse("is missing");
}

bool Container::has(const char* name) const {
  for (int64_t i = 0; i < count; ++i)
    if (std::strcmp(sections[i].name, name) == 0) return true;
  return false;
}

Bytes Container::array(const char* name, Dtype dtype, int64_t first, int64_t second, int64_t third) {
  static constexpr const char* NAMES[] = {"", "uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64",
                                          "float16", "float32", "float64", "bool"};
  static constexpr uint8_t SIZES[] = {0, 1, 1, 2, 2, 4, 4, 8, 8, 2, 4, 8, 1};
  Bytes data = section(name);
  const Blame blame(name);
  const int64_t wanted[] = {first, second, third}, axes = third >= 0 ? 3 : second >= 0 ? 2 : 1;
  if (data.left < 2) refuse(data.left, " bytes cannot hold an array header");
  const auto code = data.integer(1);
  const auto found = static_cast<int64_t>(data.integer(1));
  if (code < 1 || code > 12) refuse("unknown dtype code ", static_cast<int64_t>(code));
  if (found > 8) refuse(found, " axes, at most 8 are allowed");
  if (data.left < 4 * found) refuse(data.left + 2, " bytes cannot hold the header of an array with ", found, " axes");
  int64_t shape[8];
  double bytes = SIZES[code];
  Text listed, must;
  for (int64_t i = 0; i < found; ++i) {
    shape[i] = static_cast<int64_t>(data.integer(4));
    bytes *= static_cast<double>(shape[i]);
    if (i) listed.put(", ");
    listed.put(shape[i]);
  }
  bool same = found == axes;
  for (int64_t i = 0; i < axes; ++i) {
    same = same && shape[i] == wanted[i];
    if (i) must.put(", ");
    must.put(wanted[i]);
  }
  if (static_cast<double>(data.left) != bytes)
    refuse(grouped(data.left), " bytes of values, shape [", listed.data, "] of ", NAMES[code], " needs ",
           grouped(static_cast<int64_t>(bytes)));
  if (code != dtype) refuse("dtype is ", NAMES[code], ", must be ", NAMES[dtype]);
  if (!same) refuse("shape is [", listed.data, "], must be [", must.data, "]");
  return data;
}

const Json* Container::value(const char* key) const { return header->find("static")->find(key); }

int64_t Container::integer(const char* key, int64_t low, int64_t high) const {
  const Json* found = value(key);
  if (found == nullptr || found->kind != Json::INTEGER || found->integer < low || found->integer > high)
    refuse("header value '", key, "' must be an integer in ", low, "..", high);
  return found->integer;
}

void Container::usual(const char* part, const char* name) const {
  const Json* found = value(part);
  if (found != nullptr && !found->is(name))
    refuse("the file asks for ", part, " '", found->text, "', which this decoder lacks");
}

void Container::allow(int64_t decoded, int64_t gaussians) const {
  const int64_t most = FREE + EXPANSION * payload;
  if (decoded > most)
    refuse("claims a model of ", grouped(gaussians), " Gaussians of ", grouped(decoded), " bytes in memory, a file of ",
           grouped(payload), " may stand for at most ", grouped(most));
}

void Container::finish() const {
  const Section* unknown = nullptr;  // the first by name
  for (int64_t i = 0; i < count; ++i)
    if (!sections[i].read && (unknown == nullptr || std::strcmp(sections[i].name, unknown->name) < 0))
      unknown = &sections[i];
  if (unknown == nullptr) return;
  const Blame blame(unknown->name);
  refuse("method '", method->text, "' knows no such section");
}

}  // namespace swz
