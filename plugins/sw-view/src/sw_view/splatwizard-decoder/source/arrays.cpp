#include "arrays.h"

#include "inflate.h"
#include "zstd.h"

namespace swz {

Buffer<uint8_t> byte_planes(Bytes data, int64_t rows, int64_t width, int size) {
  const auto version = static_cast<int64_t>(data.integer(1)), form = static_cast<int64_t>(data.integer(1));
  const uint64_t crc = data.integer(4);
  if (version != 1 || form > 1)
    refuse("byte planes of version ", version, ", form ", form, " are not known: upgrade sw-codecs");
  const int64_t bytes = rows * width * size;
  Buffer<uint8_t> plain(bytes);
  if (form == 1) {
    Buffer<uint8_t> planes(bytes);
    unzstd(data, planes.data, bytes);
    const uint8_t* from = planes.data;
    for (int weight = 0; weight < size; ++weight)
      for (int64_t column = 0; column < width; ++column)
        for (int64_t row = 0; row < rows; ++row) plain[(row * width + column) * size + weight] = *from++;
  } else if (data.left == bytes) {
    std::memcpy(plain.data, data.data, static_cast<size_t>(bytes));
  } else {
    refuse(grouped(data.left), " bytes of values, the array takes ", grouped(bytes));
  }
  if (crc32(plain.data, bytes) != crc) refuse("the decoded values do not match their CRC-32");
  return plain;
}

Buffer<uint8_t> deflated(Bytes data, int64_t rows, int64_t width, int size) {
  if (data.left == 0) refuse("a DEFLATE array of version none: upgrade sw-codecs");
  const auto version = static_cast<int64_t>(data.integer(1));
  if (version != 1) refuse("a DEFLATE array of version ", version, ": upgrade sw-codecs");
  Buffer<uint8_t> plain(rows * width * size);
  inflate(data, plain.data, plain.size);
  return plain;
}

ArrayCoder array_coder(const char* name) {
  if (std::strcmp(name, "byte-planes") == 0) return byte_planes;
  if (std::strcmp(name, "deflate") == 0) return deflated;
  refuse("the file asks for the array coder '", name, "', which this decoder lacks");
}

void float_delta(Bytes data, int64_t rows, int64_t width, float* to) {
  const Buffer<uint8_t> steps = byte_planes(data, rows, width, 4);
  for (int64_t column = 0; column < width; ++column) {
    uint32_t rank = 0;
    for (int64_t row = 0; row < rows; ++row) {
      uint32_t step;
      std::memcpy(&step, steps.data + 4 * (row * width + column), 4);
      rank += step >> 1 ^ (0 - (step & 1));
      const uint32_t bits = rank >> 31 ? rank ^ 0x80000000u : ~rank;
      std::memcpy(to + row * width + column, &bits, 4);
    }
  }
}

void packed_bits(Bytes data, int64_t count, int width, uint32_t* to) {
  if (data.left != (count * width + 7) / 8)
    refuse(grouped(data.left), " bytes of packed bits, ", grouped(count), " of ", width, " bits are ",
           grouped((count * width + 7) / 8));
  uint64_t held = 0;
  int bits = 0;
  for (int64_t i = 0; i < count; ++i) {
    while (bits < width) {
      held = held << 8 | data.integer(1);
      bits += 8;
    }
    bits -= width;
    to[i] = static_cast<uint32_t>(held >> bits & ((uint64_t{1} << width) - 1));
  }
  if (held & ((uint64_t{1} << bits) - 1)) refuse("the padding of packed bits is not zero");
}

float half(const uint8_t* bytes) {
  const uint32_t value = bytes[0] | uint32_t{bytes[1]} << 8, sign = value >> 15 << 31;
  uint32_t exponent = value >> 10 & 31, mantissa = value & 1023, bits;
  if (exponent == 31) {
    bits = 0x7F800000u | mantissa << 13;
  } else if (exponent) {
    bits = (exponent + 112) << 23 | mantissa << 13;
  } else {
    const float small = static_cast<float>(mantissa) * 0x1p-24f;
    std::memcpy(&bits, &small, 4);
  }
  bits |= sign;
  float found;
  std::memcpy(&found, &bits, 4);
  return found;
}

Buffer<float> finite_halves(const Buffer<uint8_t>& halves) {
  Buffer<float> values(halves.size / 2);
  for (int64_t i = 0; i < values.size; ++i) values[i] = half(halves.data + 2 * i);
  check_finite(values.data, values.size);
  return values;
}

}  // namespace swz
