#include "container.h"

namespace swz {

namespace {

constexpr int64_t PREFIX = 10, MAX_HEADER = 1 << 19, MAX_SECTIONS = 4096;

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
  if (version > 2)
    refuse("container version ", version, " is newer than 2, the newest that this installation reads: upgrade "
           "splatwizard-core with pip install --upgrade splatwizard-core");
  const int64_t start = PREFIX + length + 4;
  if (size < start)
    refuse("the file ends inside its header (", grouped(size), " of ", grouped(start), " bytes): it is truncated");
  const Bytes raw = file.take(length);
  if (crc32(raw.data, raw.left) != file.integer(4))
    refuse("the CRC-32 of the header does not match: the file is damaged");
  const Json* header = parse_json(raw);
  const char* keys[] = {"cuts", "method", "method_version", "raster", "sections", "static"};
  const int first = version == 2 ? 0 : 1;
  bool exact = header->kind == Json::OBJECT && header->length == 6 - first + (header->find("requires") != nullptr);
  for (int i = first; exact && i < 6; ++i) exact = header->find(keys[i]) != nullptr;
  if (!exact)
    refuse("header must hold exactly ", first ? "" : "cuts, ",
           "method, method_version, raster, sections, static, and it may hold requires");
  return header;
}

}  // namespace

Container::Container(Bytes file, int64_t asked) {
  const int64_t size = file.left;
  header = read_header(file);
  method = member(header, "method", Json::STRING, "str");
  version = member(header, "method_version", Json::INTEGER, "int")->integer;
  member(header, "raster", Json::OBJECT, "dict");
  member(header, "static", Json::OBJECT, "dict");
  const Json* table = member(header, "sections", Json::ARRAY, "list");
  if (!is_name(*method, ".-") || version < 0 || version > INT32_MAX) refuse("header names no valid method and version");
  read_rows(table);
  int64_t wanted = table->length;
  if (const Json* rows = header->find("cuts"); rows != nullptr)
    wanted = choose_cut(rows, file.left, size - file.left, asked);
  else if (asked > 0)
    refuse("it declares no cuts, it is decoded whole or not at all");
  if (cuts && packets) {  // what lies behind the cut is not there
    int64_t bytes = 0;
    const Json* row = table->first;
    for (int64_t i = 0; i < wanted; ++i, row = row->next) bytes += row->first->next->next->integer;
    file.left = bytes;
  }
  payload = file.left;
  read_sections(table, file, wanted);
}

void Container::read_rows(const Json* table) {
  if (table->length > MAX_SECTIONS)
    refuse(grouped(table->length), " sections, at most ", MAX_SECTIONS, " are allowed");
  sections = static_cast<Section*>(std::malloc(sizeof(Section) * static_cast<size_t>(table->length + 1)));
  int64_t position = 0;
  for (const Json* row = table->first; row != nullptr; row = row->next) {
    if (row->kind != Json::ARRAY || row->length != 4 || row->first->kind != Json::STRING)
      refuse("a row of the section table is not [name, offset, length, crc32]");
    const Json* name = row->first;
    bool usable = is_name(*name, "./-") && !name->is("header");
    for (int64_t i = 0; usable && i < count; ++i) usable = !name->is(sections[i].name);
    if (!usable) refuse("section name '", name->text, "' is malformed or appears twice");
    sections[count++] = {name->text, {}, false};
    const Json *offset = name->next, *length = offset->next, *crc = length->next;
    const Blame blame(name->text);
    for (const Json* number : {offset, length, crc})
      if (number->kind != Json::INTEGER || number->integer < 0 || offset->integer != position ||
          number->integer > INT64_MAX / 8192)
        refuse("offset, length or crc32 make no sense in the section table");
    position += length->integer;
  }
}

int64_t Container::choose_cut(const Json* rows, int64_t length, int64_t header_bytes, int64_t asked) {
  if (rows->kind != Json::ARRAY || rows->length < 1 || rows->length > count)
    refuse("cuts are no list, or not from one to as many as there are sections");
  const Json* row = header->find("sections")->first;
  int64_t done = 0, bytes = 0, there = 0, chosen = 0, first_end = 0, there_end = 0;
  bool at_cut = false;
  for (const Json* cut = rows->first; cut != nullptr; cut = cut->next) {
    const Json* number = cut->first;
    if (cut->kind != Json::ARRAY || cut->length != 3 || number->kind != Json::INTEGER ||
        number->next->kind != Json::INTEGER)
      refuse("a row of the cuts is not [sections, bytes, psnr]");
    const int64_t wanted = number->integer, end = number->next->integer;
    const Json* psnr = number->next->next;
    if (psnr->kind != Json::NOTHING && !(psnr->is_number() && __builtin_fabs(psnr->number) <= 1000))
      refuse("the PSNR of a cut is beyond 1000, or no number");
    if (wanted <= done || wanted > count || end <= bytes) refuse("cuts do not grow, or lie beyond the last section");
    for (; done < wanted; ++done, row = row->next) bytes += row->first->next->next->integer;
    if (bytes != end) refuse("a cut of ", grouped(end), " bytes lies inside of a section");
    ++cuts;
    if (cuts == 1) first_end = header_bytes + end;
    if (end <= length) there = cuts, there_end = header_bytes + end;
    at_cut |= end == length;
    if (cuts == asked || (asked == 0 && end <= length)) chosen = wanted;
  }
  if (done != count) refuse("the last cut is not the end of the file");
  if (length > bytes) {  // what follows the last section is refused like that of any file
    packets = 0;
    return count;
  }
  if (!at_cut && there)
    refuse(grouped(header_bytes + length), " bytes end at no declared cut: the file is truncated; the longest cut that is "
           "whole is packet ", there, " (", grouped(there_end), " bytes): --partial decodes it");
  if (!at_cut)
    refuse(grouped(header_bytes + length), " bytes end at no declared cut: the file is truncated; the first cut is at ",
           grouped(first_end), " bytes");
  if (asked > there) refuse("it has ", there, " packets, ", asked, " are asked for");
  packets = asked ? asked : there;
  is_first_part = packets < there;
  return chosen;
}

void Container::read_sections(const Json* table, Bytes file, int64_t wanted) {
  const Json* row = table->first;
  count = wanted;
  for (int64_t i = 0; i < wanted; ++i, row = row->next) {
    const Json *length = row->first->next->next, *crc = length->next;
    const Blame blame(sections[i].name);
    if (length->integer > file.left)
      refuse("is ", grouped(file.left), " bytes, header says ", grouped(length->integer), ": the file is truncated");
    sections[i].content = file.take(length->integer);
    if (crc32(sections[i].content.data, length->integer) != crc->integer)
      refuse("its CRC-32 does not match: the file is damaged");
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
