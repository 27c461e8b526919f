#include "zstd.h"

namespace swz {

namespace {

constexpr char DAMAGED[] = "a zstd frame is damaged";

[[noreturn]] void damaged() { refuse(DAMAGED); }

int top_bit(uint32_t value) { return 31 - __builtin_clz(value); }

// Bits from the end of some bytes to their beginning; before it come zeros.
struct BackwardBits {
  const uint8_t* data;
  int64_t at;  // bits that are left; below 0 where more were taken

  explicit BackwardBits(Bytes from) : data(from.data) {
    if (from.left == 0 || from.data[from.left - 1] == 0) damaged();
    at = 8 * (from.left - 1) + top_bit(from.data[from.left - 1]);
  }
  // `count` bits that end `before` bits before the end; at most 32.
  uint32_t peek(int64_t before, int count) const {
    const int64_t low = at - before - count;
    const int64_t first = low >> 3;  // rounded down, also below 0
    uint64_t value = 0;
    for (int i = 0; i < 5; ++i)
      if (first + i >= 0 && 8 * (first + i) < at) value |= uint64_t{data[first + i]} << (8 * i);
    return static_cast<uint32_t>(value >> (low & 7)) & static_cast<uint32_t>((uint64_t{1} << count) - 1);
  }
  uint32_t take(int count) {
    const uint32_t value = peek(0, count);
    at -= count;
    return value;
  }
};

struct ForwardBits {
  Bytes from;
  int64_t at = 0;

  uint32_t peek(int count) const {
    uint32_t value = 0;
    for (int i = 0; i < count; ++i) {
      const int64_t bit = at + i;
      if (bit >> 3 < from.left) value |= uint32_t{static_cast<uint8_t>(from.data[bit >> 3] >> (bit & 7) & 1)} << i;
    }
    return value;
  }
  uint32_t take(int count) {
    const uint32_t value = peek(count);
    at += count;
    if (at > 8 * from.left) damaged();
    return value;
  }
};

constexpr int MOST_LOG = 9, MOST_SYMBOLS = 256;

// A table of finite state entropy.
struct States {
  int log = -1;  // -1: there is none yet
  uint8_t symbol[1 << MOST_LOG];
  uint8_t bits[1 << MOST_LOG];
  uint16_t base[1 << MOST_LOG];

  void build(const int16_t* shares, int symbols, int accuracy) {
    log = accuracy;
    const int size = 1 << log;
    int high = size, at = 0;
    uint16_t next[MOST_SYMBOLS];
    for (int s = 0; s < symbols; ++s)
      if (shares[s] == -1) {
        symbol[--high] = static_cast<uint8_t>(s);
        next[s] = 1;
      }
    for (int s = 0; s < symbols; ++s) {
      if (shares[s] <= 0) continue;
      next[s] = static_cast<uint16_t>(shares[s]);
      for (int i = 0; i < shares[s]; ++i) {
        symbol[at] = static_cast<uint8_t>(s);
        do at = (at + (size >> 1) + (size >> 3) + 3) & (size - 1);
        while (at >= high);
      }
    }
    for (int i = 0; i < size; ++i) {
      const uint32_t state = next[symbol[i]]++;
      bits[i] = static_cast<uint8_t>(log - top_bit(state));
      base[i] = static_cast<uint16_t>((state << bits[i]) - static_cast<uint32_t>(size));
    }
  }

  void only(uint8_t value) {
    log = 0;
    symbol[0] = value, bits[0] = 0, base[0] = 0;
  }

  // Builds the table that is described at the front.
  void read(Bytes& from, int most_log, int most_symbols) {
    ForwardBits in{from};
    const int accuracy = static_cast<int>(in.take(4)) + 5;
    if (accuracy > most_log) damaged();
    int16_t shares[MOST_SYMBOLS];
    int left = 1 << accuracy, symbols = 0;
    while (left > 0) {
      if (symbols >= most_symbols) damaged();
      const int width = top_bit(static_cast<uint32_t>(left + 1)) + 1, low = (1 << (width - 1)) - 1;
      const int threshold = (1 << width) - 1 - (left + 1);
      int value = static_cast<int>(in.peek(width));
      if ((value & low) < threshold) {
        value &= low;
        in.take(width - 1);
      } else {
        if (value > low) value -= threshold;
        in.take(width);
      }
      const int share = value - 1;
      left -= share < 0 ? 1 : share;
      shares[symbols++] = static_cast<int16_t>(share);
      if (share != 0) continue;
      for (uint32_t zeros = 3; zeros == 3;) {
        zeros = in.take(2);
        if (symbols + static_cast<int>(zeros) > most_symbols) damaged();
        for (uint32_t i = 0; i < zeros; ++i) shares[symbols++] = 0;
      }
    }
    if (left != 0) damaged();
    from.take((in.at + 7) >> 3);
    build(shares, symbols, accuracy);
  }
};

constexpr int HUFFMAN_LOG = 11;

struct Huffman {
  int log = 0;  // 0: there is none yet
  uint8_t symbol[1 << HUFFMAN_LOG], bits[1 << HUFFMAN_LOG];

  void read(Bytes& from) {
    uint8_t weights[MOST_SYMBOLS];
    int count = 0;
    const auto head = static_cast<int>(from.integer(1));
    if (head >= 128) {
      count = head - 127;
      const Bytes packed = from.take((count + 1) / 2);
      for (int i = 0; i < count; ++i) weights[i] = i % 2 ? packed.data[i / 2] & 15 : packed.data[i / 2] >> 4;
    } else {
      Bytes coded = from.take(head);
      States states;
      states.read(coded, 6, MOST_SYMBOLS);
      BackwardBits in(coded);
      uint32_t state[2] = {in.take(states.log), 0};
      state[1] = in.take(states.log);
      for (int turn = 0;; turn ^= 1) {  // two states in turn, until one asks for more bits than there are
        if (count >= MOST_SYMBOLS - 2) damaged();
        weights[count++] = states.symbol[state[turn]];
        state[turn] = states.base[state[turn]] + in.take(states.bits[state[turn]]);
        if (in.at < 0) {
          weights[count++] = states.symbol[state[turn ^ 1]];
          break;
        }
      }
    }
    build(weights, count);
  }

  // The weight of the last symbol follows from those of the others.
  void build(uint8_t* weights, int count) {
    uint32_t sum = 0;
    for (int i = 0; i < count; ++i) {
      if (weights[i] > HUFFMAN_LOG) damaged();
      sum += weights[i] ? 1u << (weights[i] - 1) : 0;
    }
    if (sum == 0) damaged();
    log = top_bit(sum) + 1;
    const uint32_t left = (1u << log) - sum;
    if (log > HUFFMAN_LOG || (left & (left - 1)) != 0) damaged();
    weights[count++] = static_cast<uint8_t>(top_bit(left) + 1);
    int at = 0;
    for (int weight = 1; weight <= log; ++weight)
      for (int s = 0; s < count; ++s)
        for (int i = 0; weights[s] == weight && i < 1 << (weight - 1); ++i, ++at) {
          symbol[at] = static_cast<uint8_t>(s);
          bits[at] = static_cast<uint8_t>(log + 1 - weight);
        }
  }

  void decode(Bytes from, uint8_t* to, int64_t count) const {
    BackwardBits in(from);
    for (int64_t i = 0; i < count; ++i) {
      const uint32_t code = in.peek(0, log);
      to[i] = symbol[code];
      in.at -= bits[code];
      if (in.at < 0) damaged();
    }
    if (in.at != 0) damaged();
  }
};

constexpr int64_t MOST_BLOCK = 1 << 17;
constexpr int LENGTHS = 36, OFFSETS = 32, MATCHES = 53;
constexpr uint32_t LENGTH_BASE[LENGTHS] = {0,  1,  2,  3,  4,  5,  6,  7,  8,   9,   10,  11,   12,   13,   14,   15,    16,    18,
                                           20, 22, 24, 28, 32, 40, 48, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768, 65536};
constexpr uint8_t LENGTH_BITS[LENGTHS] = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,  0,  0,  0,  1,  1,
                                          1, 1, 2, 2, 3, 3, 4, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};
constexpr uint32_t MATCH_BASE[MATCHES] = {3,  4,  5,  6,  7,  8,  9,  10, 11, 12, 13, 14, 15,  16,  17,  18,   19,   20,
                                          21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31, 32, 33,  34,  35,  37,   39,   41,
                                          43, 47, 51, 59, 67, 83, 99, 131, 259, 515, 1027, 2051, 4099, 8195, 16387, 32771, 65539};
constexpr uint8_t MATCH_BITS[MATCHES] = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,  0,  0,  0,  0,  0,  0,  0,  0,  0,  0,  0, 0,
                                         0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 3, 3, 4, 4,  5,  7,  8,  9,  10, 11, 12, 13, 14, 15, 16};
constexpr int16_t USUAL_LENGTHS[LENGTHS] = {4, 3, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 1, 1, 1,  2,  2,
                                            2, 2, 2, 2, 2, 2, 2, 3, 2, 1, 1, 1, 1, 1, -1, -1, -1, -1};
constexpr int16_t USUAL_MATCHES[MATCHES] = {1, 4, 3, 2, 2, 2, 2, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1,  1,  1,  1,  1,  1,  1, 1, 1, 1, 1,
                                            1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1,  1,  1,  -1, -1, -1, -1, -1, -1, -1};
constexpr int16_t USUAL_OFFSETS[29] = {1, 1, 1, 1, 1, 1, 2, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1};

struct Decoder {
  uint8_t *begin, *at, *end;
  Huffman huffman;
  States lengths, offsets, matches;
  uint32_t recent[3] = {1, 4, 8};
  Buffer<uint8_t> literals{MOST_BLOCK};
  int64_t literal_count = 0;

  void read_literals(Bytes& from) {
    if (from.left < 1) damaged();
    const int type = from.data[0] & 3, format = from.data[0] >> 2 & 3;
    if (type < 2) {
      const int size = format == 1 ? 2 : format == 3 ? 3 : 1;
      literal_count = static_cast<int64_t>(from.integer(size) >> (size == 1 ? 3 : 4));
      if (literal_count > MOST_BLOCK) damaged();
      const Bytes plain = from.take(type == 0 ? literal_count : 1);
      if (type == 0) std::memcpy(literals.data, plain.data, static_cast<size_t>(literal_count));
      else std::memset(literals.data, plain.data[0], static_cast<size_t>(literal_count));
      return;
    }
    const int width = format < 2 ? 10 : format == 2 ? 14 : 18;
    const uint64_t head = from.integer(format < 2 ? 3 : format == 2 ? 4 : 5), mask = (uint64_t{1} << width) - 1;
    literal_count = static_cast<int64_t>(head >> 4 & mask);
    if (literal_count > MOST_BLOCK) damaged();
    Bytes coded = from.take(static_cast<int64_t>(head >> (4 + width) & mask));
    if (type == 2) huffman.read(coded);
    if (huffman.log == 0) damaged();
    if (format == 0) return huffman.decode(coded, literals.data, literal_count);
    int64_t sizes[3], done = 0;
    for (auto& size : sizes) size = static_cast<int64_t>(coded.integer(2));
    const int64_t part = (literal_count + 3) / 4;
    if (3 * part > literal_count) damaged();
    for (const int64_t size : sizes) {
      huffman.decode(coded.take(size), literals.data + done, part);
      done += part;
    }
    huffman.decode(coded, literals.data + done, literal_count - done);
  }

  static void choose(States& table, int mode, Bytes& from, const int16_t* usual, int symbols, int usual_log, int most_log, int most_symbols) {
    if (mode == 0) table.build(usual, symbols, usual_log);
    if (mode == 1) {
      const auto symbol = from.integer(1);
      if (symbol >= static_cast<uint64_t>(most_symbols)) damaged();
      table.only(static_cast<uint8_t>(symbol));
    }
    if (mode == 2) table.read(from, most_log, most_symbols);
    if (table.log < 0) damaged();
  }

  uint32_t offset_of(uint32_t value, uint32_t length) {
    if (value > 3) {
      recent[2] = recent[1], recent[1] = recent[0];
      return recent[0] = value - 3;
    }
    const uint32_t which = value - 1 + (length == 0);  // 3: one less than the latest
    const uint32_t found = which < 3 ? recent[which] : recent[0] - 1;
    if (which > 1) recent[2] = recent[1];
    if (which > 0) recent[1] = recent[0], recent[0] = found;
    return found;
  }

  void put_literals(const uint8_t*& literal, int64_t count) {
    if (count > literals.data + literal_count - literal || count > end - at) damaged();
    std::memcpy(at, literal, static_cast<size_t>(count));
    at += count, literal += count;
  }

  void sequences(Bytes from) {
    const uint8_t* literal = literals.data;
    auto count = static_cast<int64_t>(from.integer(1));
    if (count >= 255) count = static_cast<int64_t>(from.integer(2)) + 0x7F00;
    else if (count >= 128) count = (count - 128) << 8 | static_cast<int64_t>(from.integer(1));
    if (count > 0) {
      const auto modes = static_cast<int>(from.integer(1));
      if (modes & 3) damaged();
      choose(lengths, modes >> 6, from, USUAL_LENGTHS, LENGTHS, 6, 9, LENGTHS);
      choose(offsets, modes >> 4 & 3, from, USUAL_OFFSETS, 29, 5, 8, OFFSETS);
      choose(matches, modes >> 2 & 3, from, USUAL_MATCHES, MATCHES, 6, 9, MATCHES);
      BackwardBits in(from);
      uint32_t l = in.take(lengths.log), o = in.take(offsets.log), m = in.take(matches.log);
      for (int64_t i = 0; i < count; ++i) {
        const int of = offsets.symbol[o], ml = matches.symbol[m], ll = lengths.symbol[l];
        const uint32_t value = (1u << of) + in.take(of);
        const uint32_t match = MATCH_BASE[ml] + in.take(MATCH_BITS[ml]);
        const uint32_t length = LENGTH_BASE[ll] + in.take(LENGTH_BITS[ll]);
        if (i + 1 < count) {
          l = lengths.base[l] + in.take(lengths.bits[l]);
          m = matches.base[m] + in.take(matches.bits[m]);
          o = offsets.base[o] + in.take(offsets.bits[o]);
        }
        if (in.at < 0) damaged();
        put_literals(literal, length);
        const uint32_t back = offset_of(value, length);
        if (back == 0 || back > at - begin || match > end - at) damaged();
        for (uint32_t k = 0; k < match; ++k, ++at) *at = at[-static_cast<int64_t>(back)];
      }
      if (in.at != 0) damaged();
    } else if (from.left) {
      damaged();
    }
    put_literals(literal, literals.data + literal_count - literal);
  }

  void block(int type, Bytes& from, int64_t size) {
    if (type == 3 || size > MOST_BLOCK) damaged();
    if (type == 2) {
      Bytes content = from.take(size);
      read_literals(content);
      return sequences(content);
    }
    if (size > end - at) damaged();
    const Bytes content = from.take(type == 0 ? size : 1);
    if (type == 0) std::memcpy(at, content.data, static_cast<size_t>(size));
    else std::memset(at, content.data[0], static_cast<size_t>(size));
    at += size;
  }
};

}  // namespace

void unzstd(Bytes frame, uint8_t* out, int64_t size) {
  cut = DAMAGED;
  if (frame.left < 6 || frame.integer(4) != 0xFD2FB528) damaged();
  const auto head = static_cast<int>(frame.integer(1));
  const bool single = head >> 5 & 1;
  if (head & 8) damaged();
  if (!single) frame.take(1);  // the window: all that was decoded is at hand
  const int dictionary = head & 3 ? 1 << ((head & 3) - 1) : 0, stated = head >> 6 ? 1 << (head >> 6) : single;
  if (dictionary && frame.integer(dictionary) != 0) damaged();
  const uint64_t content = stated ? frame.integer(stated) + (stated == 2 ? 256 : 0) : ~uint64_t{0};
  if (content != static_cast<uint64_t>(size))
    refuse("a zstd frame does not hold the ", grouped(size), " bytes that are expected");
  Decoder decoder{out, out, out + size};
  for (bool last = false; !last;) {
    if (frame.left < 3) damaged();
    const auto block = frame.integer(3);
    last = block & 1;
    decoder.block(static_cast<int>(block >> 1 & 3), frame, static_cast<int64_t>(block >> 3));
  }
  if (head & 4) frame.take(4);
  if (frame.left || decoder.at != decoder.end) damaged();
  cut = nullptr;
}

}  // namespace swz
