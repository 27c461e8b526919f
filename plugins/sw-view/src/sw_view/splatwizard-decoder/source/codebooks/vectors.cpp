#include "vectors.h"

#include "arrays.h"
#include "categorical.h"

namespace swz {

namespace {

constexpr int64_t MOST_ENTRIES = 1 << 16;

struct Header {
  int64_t form, entries, own;
  ArrayCoder arrays = byte_planes;
};

Header header_of(Bytes data, int64_t count) {
  if (data.left < 14) refuse(data.left, " bytes, must be 14");
  const auto version = static_cast<int64_t>(data.integer(1));
  Header found{static_cast<int64_t>(data.integer(1)), 0, 0};
  const auto stated = static_cast<int64_t>(data.integer(4));
  found.entries = static_cast<int64_t>(data.integer(4));
  found.own = static_cast<int64_t>(data.integer(4));
  if (version == 2) {
    const void* end = std::memchr(data.data, 0, static_cast<size_t>(data.left));
    if (end != data.data) refuse("the file asks for an entropy model of its indices, which this decoder lacks");
    data.take(1);
    Text name;
    for (int64_t i = 0; i < data.left && i < 64; ++i) {
      const char letter[2] = {static_cast<char>(data.data[i]), 0};
      name.put(letter);
    }
    found.arrays = array_coder(name.data);
  } else if (data.left) {
    refuse(data.left + 14, " bytes, must be 14");
  }
  if (version < 1 || version > 2 || found.form > 1)
    refuse("vectors of version ", version, ", form ", found.form, " are not known: upgrade sw-lightgaussian");
  if (stated != count) refuse("there are ", grouped(stated), " vectors, expected ", grouped(count));
  const int64_t coded = count - found.own, most = coded < MOST_ENTRIES ? coded : MOST_ENTRIES;
  if (coded < 0 || found.entries > most || (coded > 0 && found.entries == 0))
    refuse(grouped(found.entries), " codebook entries and ", grouped(found.own), " own vectors cannot be of ",
           grouped(count), " vectors");
  return found;
}

int width_of(int64_t entries) {
  int width = 1;
  while (int64_t{1} << width < entries) ++width;
  return width;
}

}  // namespace

Vectors importance_vq(Container& file, const VectorParts& parts, int64_t count, int64_t width) {
  static constexpr const char* NAMES[] = {"header", "mask", "indices", "codebook", "own"};
  Bytes data[5];
  for (int i = 0; i < 5; ++i) data[i] = file.section(parts.sections[i]);
  const auto blame = [&](int i) {
    return parts.as_parts ? Blame(parts.sections[0], NAMES[i]) : Blame(parts.sections[i]);
  };
  Header header;
  {
    const Blame by = blame(0);
    header = header_of(data[0], count);
  }
  Buffer<uint32_t> keeps(count);
  {
    const Blame by = blame(1);
    const Buffer<uint8_t> mask = header.arrays(data[1], (count + 7) / 8, 1, 1);
    packed_bits({mask.data, mask.size}, count, 1, keeps.data);
    int64_t own = 0;
    for (int64_t i = 0; i < count; ++i) own += keeps[i];
    if (own != header.own) refuse("keeps ", grouped(own), " vectors, the header says ", grouped(header.own));
  }
  Vectors found{{}, {}, Buffer<uint32_t>(count), width};
  {
    const Blame by = blame(2);
    const int64_t coded = count - header.own, size = header.entries > 0 ? header.entries : 1;
    Buffer<uint32_t> indices(coded);
    if (header.form == 0) packed_bits(data[2], coded, width_of(size), indices.data);
    else categorical(data[2], size, coded, indices.data);
    uint32_t own = static_cast<uint32_t>(header.entries);
    int64_t next = 0;
    for (int64_t i = 0; i < coded; ++i)
      if (indices[i] >= header.entries)
        refuse("an index is outside the codebook of ", grouped(header.entries), " entries");
    for (int64_t i = 0; i < count; ++i) found.code[i] = keeps[i] ? own++ : indices[next++];
  }
  const auto halves = [&](int i, int64_t rows) {
    const Blame by = blame(i);
    return finite_halves(header.arrays(data[i], rows, width, 2));
  };
  found.codebook = halves(3, header.entries);
  found.own = halves(4, header.own);
  return found;
}

}  // namespace swz
