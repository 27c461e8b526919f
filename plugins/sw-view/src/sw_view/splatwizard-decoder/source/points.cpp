#include "points.h"

#include <range_coded.h>

#include "columns.h"

namespace swz {

namespace {

constexpr int64_t ALWAYS_ALLOWED = 1 << 16, POINTS_PER_BYTE = 64, CONTEXTS = 4, OCCUPANCIES = 255;
constexpr int OWN = 1, LATEST = 2;  // else equal counts

int64_t point_limit(int64_t bytes, int64_t most) {
  const int64_t allowed = POINTS_PER_BYTE * bytes > ALWAYS_ALLOWED ? POINTS_PER_BYTE * bytes : ALWAYS_ALLOWED;
  return allowed < most ? allowed : most;
}

// Tables of counts [depth, 4, 255] of all levels and contexts.
Buffer<int64_t> level_tables(Bytes& from, const uint8_t* actions, int64_t depth) {
  Buffer<int64_t> sizes(depth * CONTEXTS), tables(depth * CONTEXTS * OCCUPANCIES);
  int64_t wanted = 0;
  const auto action = [&](int64_t at) { return actions[at / CONTEXTS] >> (2 * (at % CONTEXTS)) & 3; };
  for (int64_t at = 0; at < depth * CONTEXTS; ++at)
    if (action(at) == OWN) sizes[wanted++] = OCCUPANCIES;
  const Buffer<int64_t> stored = stored_tables(from, sizes.data, wanted);
  const int64_t* next = stored.data;
  for (int64_t at = 0; at < depth * CONTEXTS; ++at) {
    int64_t* table = tables.data + at * OCCUPANCIES;
    if (action(at) == OWN || (action(at) == LATEST && at >= CONTEXTS)) {
      const int64_t* source = action(at) == OWN ? next : table - CONTEXTS * OCCUPANCIES;
      std::memcpy(table, source, sizeof(int64_t) * OCCUPANCIES);
      if (action(at) == OWN) next += OCCUPANCIES;
    } else {
      for (int64_t i = 0; i < OCCUPANCIES; ++i) table[i] = 1;
    }
  }
  return tables;
}

void check_tables(const Buffer<int64_t>& tables) {
  for (int64_t at = 0; at < tables.size; at += OCCUPANCIES) {
    bool any = false;
    for (int64_t i = 0; i < OCCUPANCIES; ++i) any |= tables[at + i] > 0;
    if (!any) refuse("a count table is empty");
  }
}

// The distinct points: Morton codes, ascending.
Buffer<int64_t> leaves_of(Bytes& from, int64_t bits, int64_t distinct) {
  const auto depth = static_cast<int64_t>(from.integer(1));
  if (depth > bits) refuse(depth, " levels, but only ", bits, " bits an axis");
  const Bytes actions = from.take(depth);
  const Buffer<int64_t> tables = level_tables(from, actions.data, depth);
  const Bytes words = from.take(from.length());
  check_tables(tables);
  const uint64_t crc = from.integer(4);
  if (words.left % 4) refuse(grouped(words.left), " coded bytes are not whole 32-bit words");
  Buffer<int64_t> nodes(distinct), sizes(depth + 1);
  Buffer<uint8_t> occupancies(depth * distinct);
  sizes.clear();
  const int32_t status = arch_native::decode_octree({words.data, words.left, depth, distinct, tables.data}, nodes.data,
                                                    occupancies.data, sizes.data);
  if (status == splatwizard::BEYOND_LIMIT) {
    int64_t level = -1;
    for (int64_t i = 0; i <= depth; ++i) level += sizes[i] > 0;
    refuse("level ", level, " has more nodes than the ", grouped(distinct), " points that were announced");
  }
  uint32_t found = 0;
  const uint8_t* next = occupancies.data;
  for (int64_t level = 0; level < depth && !status; ++level)
    for (int64_t i = 0; i < sizes[level]; ++i) {
      const int32_t symbol = *next++ - 1;
      found = crc32(&symbol, 4, found);
    }
  if (status || found != crc) refuse(CRC_DIFFERS);
  if (sizes[depth] != distinct)
    refuse(grouped(sizes[depth]), " points were found, ", grouped(distinct), " were announced");
  const auto suffix = static_cast<int>(3 * (bits - depth));
  RawBits raw(from, distinct, suffix);
  if (suffix)
    for (int64_t i = 0; i < distinct; ++i) nodes[i] = static_cast<int64_t>(static_cast<uint64_t>(nodes[i]) << suffix | raw.next(suffix));
  raw.finish();
  return nodes;
}

// Times that each distinct point occurs.
Buffer<int32_t> times_of(Bytes& from, int64_t count, int64_t distinct) {
  Buffer<int32_t> times(distinct);
  for (int64_t i = 0; i < distinct; ++i) times[i] = 1;
  const auto places = static_cast<int64_t>(from.varint(static_cast<uint64_t>(distinct)));
  int64_t sum = distinct;
  if (places) {
    Columns matrix(from.take(from.length()), places, 2);
    Buffer<int64_t> steps(places), extra(places);
    matrix.next(steps.data);
    matrix.next(extra.data);
    matrix.finish();
    int64_t index = 0;
    for (int64_t i = 0; i < places; ++i) {
      if (steps[i] < (i ? 1 : 0) || steps[i] >= distinct - index)
        refuse("the indices of duplicated points are out of range");
      index += steps[i];
      steps[i] = index;
    }
    for (int64_t i = 0; i < places; ++i) {
      if (extra[i] <= 0 || extra[i] > count) refuse("the number of duplicates is out of range");
      times[steps[i]] += static_cast<int32_t>(extra[i]);
      sum += extra[i];
    }
  }
  if (sum != count) refuse(grouped(sum), " points with duplicates, ", grouped(count), " were announced");
  return times;
}

}  // namespace

Points octree(Bytes data, int64_t most) {
  const int64_t bytes = data.left;
  const auto version = static_cast<int64_t>(data.integer(1)), bits = static_cast<int64_t>(data.integer(1));
  if (version != 1) refuse("octree of version ", version, " is not known: upgrade sw-codecs");
  if (bits < 1 || bits > 21) refuse(bits, " bits an axis, must be 1..21");
  const auto count = static_cast<int64_t>(data.varint(static_cast<uint64_t>(point_limit(bytes, most))));
  const auto distinct = static_cast<int64_t>(data.varint(static_cast<uint64_t>(count)));
  if ((count == 0) != (distinct == 0)) refuse(grouped(count), " points, but ", grouped(distinct), " distinct ones");
  Points points{Buffer<int64_t>(count), bits};
  if (distinct) {
    const Buffer<int64_t> leaves = leaves_of(data, bits, distinct);
    const Buffer<int32_t> times = times_of(data, count, distinct);
    int64_t at = 0;
    for (int64_t i = 0; i < distinct; ++i)
      for (int32_t k = 0; k < times[i]; ++k) points.codes[at++] = leaves[i];
  }
  const uint64_t crc = data.integer(4);
  data.finish();
  if (crc32(points.codes.data, 8 * count) != crc) refuse("the decoded points do not match their CRC-32");
  return points;
}

}  // namespace swz
