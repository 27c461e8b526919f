#include "residual.h"

#include "arrays.h"
#include "categorical.h"

namespace swz {

namespace {

constexpr int64_t HEADER = 9, MOST_ENTRIES = 1 << 15, MOST_STAGES = 16;

void unpack(Bytes data, const char* coder, int64_t entries, int64_t stages, int64_t symbols, uint32_t* to) {
  if (std::strcmp(coder, "packed-bits") != 0)
    return categorical(data, entries, symbols, to, {stages}, coder_of(coder));
  int width = 1;
  while (int64_t{1} << width < entries) ++width;
  packed_bits(data, symbols, width, to);
}

}  // namespace

Buffer<float> residual_vq(Container& file, const char* const (&sections)[3], int64_t count, int64_t width) {
  Bytes header = file.section(sections[0]), codebooks = file.section(sections[1]);
  const Bytes indices = file.section(sections[2]);
  const Blame blame(sections[2]);
  if (header.left < HEADER)
    refuse("part 'header' is ", header.left, " bytes, must be ", HEADER, " and a name");
  const auto version = static_cast<int64_t>(header.integer(1)), half_ones = static_cast<int64_t>(header.integer(1));
  const auto stages = static_cast<int64_t>(header.integer(1)), entries = static_cast<int64_t>(header.integer(2));
  const auto stated = static_cast<int64_t>(header.integer(4));
  if (version != 1 || half_ones > 1)
    refuse("residual-vq data of version ", version, ", form ", half_ones, " is not known: upgrade sw-codecs");
  if (stated != count || stages < 1 || stages > MOST_STAGES || entries < 1 || entries > MOST_ENTRIES)
    refuse(grouped(stated), " vectors of ", stages, " stages of ", grouped(entries), " entries, expected ",
           grouped(count), " vectors");
  Text coder;
  for (int64_t i = 0; i < header.left && i < 64; ++i) {
    const char letter[2] = {static_cast<char>(header.data[i]), 0};
    coder.put(header.data[i] < 0x80 ? letter : "\xEF\xBF\xBD");  // ASCII is what it may be
  }
  if (std::strcmp(coder.data, "packed-bits") != 0 && coder_of(coder.data) == Coder::NONE)
    refuse("the coder of the indices is '", coder.data, "', which is not installed");
  const int64_t numbers = stages * entries * width, bytes = numbers * (half_ones ? 2 : 4);
  if (codebooks.left != bytes)
    refuse("part 'codebooks' is ", grouped(codebooks.left), " bytes, ", stages, " of ", grouped(entries),
           " entries of ", width, " numbers are ", grouped(bytes));
  Buffer<uint32_t> symbols(count * stages);
  unpack(indices, coder.data, entries, stages, symbols.size, symbols.data);
  Buffer<float> books(numbers), found(count * width);
  bool finite = true, within = true;
  for (int64_t i = 0; i < numbers; ++i) {
    books[i] = half_ones ? half(codebooks.data + 2 * i) : float_at(codebooks.data + 4 * i);
    finite &= __builtin_isfinite(books[i]);
  }
  if (!finite) refuse("side information 'codebooks' holds values that are not finite");
  for (int64_t i = 0; i < symbols.size; ++i) within &= symbols[i] < entries;
  if (!within) refuse("a quantizer index is outside its range");
  for (int64_t i = 0; i < count; ++i)
    for (int64_t k = 0; k < width; ++k) {
      float sum = books[symbols[i * stages] * width + k];
      for (int64_t s = 1; s < stages; ++s) sum += books[(s * entries + symbols[i * stages + s]) * width + k];
      found[i * width + k] = sum;
      finite &= __builtin_isfinite(sum);
    }
  if (!finite) refuse("a decoded value is not finite in float32");
  return found;
}

}  // namespace swz
