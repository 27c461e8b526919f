#include "base.h"

#include <new>

namespace swz {

Text refusal;
const char *blamed = nullptr, *part = nullptr, *cut = nullptr;

void begin_refusal() {
  refusal.size = 0;
  if (blamed != nullptr) {
    refusal.put("section '");
    refusal.put(blamed);
    refusal.put("': ");
  }
  if (part != nullptr) {
    refusal.put("part '");
    refusal.put(part);
    refusal.put("': ");
  }
}

void Bytes::refuse_to_take(int64_t count) const {
  if (cut != nullptr) refuse(cut);
  refuse(grouped(count), " bytes are needed, ", grouped(left), " are left: the data is truncated");
}

void Text::put(int64_t value, bool grouped) {
  char digits[32];
  int at = sizeof(digits) - 1, written = 0;
  uint64_t left = value < 0 ? 0 - static_cast<uint64_t>(value) : static_cast<uint64_t>(value);
  digits[at] = 0;
  do {
    if (grouped && written && written % 3 == 0) digits[--at] = ',';
    digits[--at] = static_cast<char>('0' + left % 10);
    left /= 10;
    ++written;
  } while (left);
  if (value < 0) digits[--at] = '-';
  put(digits + at);
}

namespace {

uint32_t crc_tables[8][256];

void make_crc_tables() {
  for (uint32_t i = 0; i < 256; ++i) {
    uint32_t value = i;
    for (int bit = 0; bit < 8; ++bit) value = value >> 1 ^ (value & 1 ? 0xEDB88320u : 0u);
    crc_tables[0][i] = value;
  }
  for (int table = 1; table < 8; ++table)
    for (int i = 0; i < 256; ++i) {
      const uint32_t value = crc_tables[table - 1][i];
      crc_tables[table][i] = value >> 8 ^ crc_tables[0][value & 255];
    }
}

}  // namespace

uint32_t crc32(const void* bytes, int64_t count, uint32_t before) {
#ifdef SWZ_BLIND  // for fuzzing: no checksum stands in the way
  return 0;
#endif
  if (crc_tables[0][1] == 0) make_crc_tables();
  const auto& t = crc_tables;
  const auto* data = static_cast<const uint8_t*>(bytes);
  uint32_t crc = ~before;
  for (; count >= 8; count -= 8, data += 8) {  // eight bytes a turn, each by the table of what follows it
    uint32_t low, high;
    std::memcpy(&low, data, 4);
    std::memcpy(&high, data + 4, 4);
    low ^= crc;
    crc = t[7][low & 255] ^ t[6][low >> 8 & 255] ^ t[5][low >> 16 & 255] ^ t[4][low >> 24] ^ t[3][high & 255] ^
          t[2][high >> 8 & 255] ^ t[1][high >> 16 & 255] ^ t[0][high >> 24];
  }
  for (; count > 0; --count) crc = crc >> 8 ^ t[0][(crc ^ *data++) & 255];
  return ~crc;
}

namespace {

constexpr size_t LARGE = 1 << 17, GRAIN = 16, PAGE = 1 << 16;

// Large blocks that are free, by address; neighbours are one.
struct Free {
  Free* next;
  size_t bytes;
  char* end() { return reinterpret_cast<char*>(this) + bytes; }
};
Free* first_free = nullptr;

void add_free(void* data, size_t bytes) {
  Free **at = &first_free, *before = nullptr;
  while (*at != nullptr && *at < data) before = *at, at = &before->next;
  auto* own = static_cast<Free*>(data);
  *own = {*at, bytes};
  *at = own;
  if (own->next != nullptr && own->end() == reinterpret_cast<char*>(own->next))
    own->bytes += own->next->bytes, own->next = own->next->next;
  if (before != nullptr && before->end() == reinterpret_cast<char*>(own))
    before->bytes += own->bytes, before->next = own->next;
}

size_t whole_grains(size_t bytes) { return (bytes + GRAIN - 1) / GRAIN * GRAIN; }

}  // namespace

void* take_memory(size_t bytes) {
  if (bytes < LARGE) return std::malloc(bytes);
  bytes = whole_grains(bytes);
  for (bool grown = false;; grown = true) {
    size_t at_end = 0;
    const size_t end = __builtin_wasm_memory_size(0) * PAGE;
    for (Free** at = &first_free; *at != nullptr; at = &(*at)->next) {
      Free* found = *at;
      if (found->bytes >= bytes) {
        if (found->bytes > bytes) {
          auto* rest = reinterpret_cast<Free*>(reinterpret_cast<char*>(found) + bytes);
          *rest = {found->next, found->bytes - bytes};
          *at = rest;
        } else {
          *at = found->next;
        }
        return found;
      }
      if (reinterpret_cast<size_t>(found->end()) == end) at_end = found->bytes;
    }
    if (grown) return nullptr;
    const size_t pages = (bytes - at_end + PAGE - 1) / PAGE, from = __builtin_wasm_memory_grow(0, pages);
    if (from == ~size_t{0}) return nullptr;
    add_free(reinterpret_cast<void*>(from * PAGE), pages * PAGE);
  }
}

void give_memory(void* data, size_t bytes) {
  if (data == nullptr) return;
  if (bytes < LARGE) return std::free(data);
  add_free(data, whole_grains(bytes));
}

uint64_t Bytes::varint(uint64_t limit) {
  uint64_t value = 0;
  for (int i = 0; i < 10; ++i) {
    const uint64_t byte = integer(1);
    if (i == 9 && byte > 1 && byte < 128) refuse("an integer has too many bytes");
    value |= (byte & 127) << (7 * i);
    if (byte < 128) {
      if (value > limit || (byte == 0 && i > 0))
        refuse("an integer is ", grouped(static_cast<int64_t>(value)), ", at most ",
               grouped(static_cast<int64_t>(limit)), " is allowed");
      return value;
    }
  }
  refuse("an integer has too many bytes");
}

}  // namespace swz

// What the kernels throw when memory runs out ends the decoding too. In place of the library's, which brings printf along.
extern "C" {
void* __cxa_allocate_exception(size_t) noexcept {
  swz::blamed = swz::part = nullptr;
  swz::refuse("the decoder has no more memory");
}
void __cxa_throw(void*, void*, void (*)(void*)) { __builtin_trap(); }
void __cxa_pure_virtual() { __builtin_trap(); }
}

void* operator new(size_t bytes) {
  void* found = std::malloc(bytes ? bytes : 1);
  if (found == nullptr) __cxa_allocate_exception(0);
  return found;
}
void operator delete(void* data) noexcept { std::free(data); }
void operator delete(void* data, size_t) noexcept { std::free(data); }
