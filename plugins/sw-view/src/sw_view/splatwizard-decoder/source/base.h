// Memory, refusals and fields off the front of some bytes: what all files of the decoder share.
//
// There are no exceptions. `refuse` keeps its text for the host and traps; the host throws the instance away with its
// memory, so nothing is released on the way out. An instance decodes one file.
#pragma once
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <initializer_list>

namespace swz {

// The text of a refusal, put together from parts.
struct Text {
  char data[512] = "";
  int size = 0;

  void put(const char* text) {
    while (*text && size < int(sizeof(data)) - 1) data[size++] = *text++;
    data[size] = 0;
  }
  // Decimal digits; `grouped` puts a comma between thousands.
  void put(int64_t value, bool grouped = false);
};

// An integer with a comma between thousands.
struct Grouped {
  int64_t value;
};
inline Grouped grouped(int64_t value) { return {value}; }

inline void put(Text& text, const char* part) { text.put(part); }
inline void put(Text& text, int part) { text.put(int64_t{part}); }
inline void put(Text& text, int64_t part) { text.put(part); }
inline void put(Text& text, Grouped part) { text.put(part.value, true); }

extern Text refusal;
extern const char* blamed;  // the section that is being decoded; null: the file or its header
extern const char* part;    // what of it; null: all
extern const char* cut;     // what it means that bytes run out; null: that is said as it is

void begin_refusal();  // with what is blamed

// Ends the decoding with a reason in the words of the Python reader.
template <class... Parts>
[[noreturn, gnu::cold, gnu::noinline]] void refuse(Parts... parts) {
  begin_refusal();
  (put(refusal, parts), ...);
  __builtin_trap();
}

// Blames what goes wrong during its life on a section, or on a part of it.
struct Blame {
  const char *before = blamed, *part_before = part;
  explicit Blame(const char* section, const char* of = nullptr) { blamed = section, part = of; }
  ~Blame() { blamed = before, part = part_before; }
  Blame(const Blame&) = delete;
};

// Memory, or null. The C library rounds large blocks up to powers of two; these are as long as they are asked for.
void* take_memory(size_t bytes);
void give_memory(void* data, size_t bytes);

// Memory of a fixed number of values, not initialised.
template <class T>
struct Buffer {
  T* data = nullptr;
  int64_t size = 0;

  Buffer() = default;
  explicit Buffer(int64_t count) : size(count) {
    const auto most = static_cast<int64_t>(INT32_MAX / sizeof(T));
    data = count > most ? nullptr : static_cast<T*>(take_memory(bytes()));
    if (data == nullptr) {
      blamed = part = nullptr;
      refuse("the decoder has no more memory");
    }
  }
  ~Buffer() { give_memory(data, bytes()); }
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  Buffer(Buffer&& other) noexcept : data(other.data), size(other.size) { other.data = nullptr; }
  Buffer& operator=(Buffer&& other) noexcept {
    T* mine = data;
    const int64_t count = size;
    data = other.data, size = other.size, other.data = mine, other.size = count;
    return *this;
  }
  size_t bytes() const { return sizeof(T) * static_cast<size_t>(size > 0 ? size : 1); }
  T& operator[](int64_t i) const { return data[i]; }
  void clear() const { std::memset(data, 0, sizeof(T) * static_cast<size_t>(size)); }
};

uint32_t crc32(const void* data, int64_t bytes, uint32_t before = 0);

inline int64_t unzigzag(uint64_t value) { return static_cast<int64_t>(value >> 1) ^ -static_cast<int64_t>(value & 1); }

inline double power_of_two(int exponent) {
  const uint64_t bits = static_cast<uint64_t>(1023 + exponent) << 52;
  double value;
  std::memcpy(&value, &bits, 8);
  return value;
}

// Class with m mantissa bits (docs/bitstream.md, building blocks): how many low bits are left over, and the smallest
// integer of the class.
inline int64_t class_bits(int64_t number, int mantissa) {
  const int64_t e = (number >> mantissa) - 1;
  return e > 0 ? e : 0;
}
inline uint64_t class_floor(int64_t number, int mantissa) {
  const int64_t e = class_bits(number, mantissa);
  return static_cast<uint64_t>(number - (e << mantissa)) << e;
}

// Takes fields off the front; running out of bytes is a refusal.
struct Bytes {
  const uint8_t* data = nullptr;
  int64_t left = 0;

  Bytes take(int64_t count) {
    if (count < 0 || count > left) refuse_to_take(count);
    const Bytes taken{data, count};
    data += count;
    left -= count;
    return taken;
  }
  uint64_t integer(int size) {
    const Bytes taken = take(size);
    uint64_t value = 0;
    for (int i = 0; i < size; ++i) value |= uint64_t{taken.data[i]} << (8 * i);
    return value;
  }
  uint64_t varint(uint64_t limit);
  int64_t length() { return static_cast<int64_t>(varint(static_cast<uint64_t>(left))); }
  int64_t signed_varint() { return unzigzag(varint(~uint64_t{0})); }
  void finish() const {
    if (left) refuse(grouped(left), " unknown bytes at the end");
  }
  [[noreturn]] void refuse_to_take(int64_t count) const;
};

// Integers of a fixed number of bits, each from its least significant bit up.
struct RawBits {
  const uint8_t* data;
  int64_t bytes, at = 0;
  uint64_t held = 0;
  int count = 0;

  // Takes what `values` integers of `width` bits need.
  RawBits(Bytes& from, int64_t values, int64_t width) {
    bytes = (values * width + 7) / 8;
    data = from.take(bytes).data;
  }
  uint64_t next(int width) {
    if (width > 32) {
      const uint64_t low = next(32);
      return low | next(width - 32) << 32;
    }
    while (count < width) {
      held |= uint64_t{data[at++]} << count;
      count += 8;
    }
    const uint64_t value = held & ((uint64_t{1} << width) - 1);
    held >>= width;
    count -= width;
    return value;
  }
  void finish() const {
    if (held) refuse("the padding of raw bits is not zero");
  }
};

}  // namespace swz
