#include "planes.h"

#include <range_coded.h>

#include "escapes.h"
#include "symbols.h"

namespace swz {

namespace {

constexpr splatwizard::Parallel ALONE;
constexpr int64_t DOWN[12] = {-2, -2, -2, -2, -2, -1, -1, -1, -1, -1, 0, 0};
constexpr int64_t RIGHT[12] = {-2, -1, 0, 1, 2, -2, -1, 0, 1, 2, -2, -1};
constexpr int64_t PLANE_LIMIT = 1 << 24;

// Puts channels last: [3, channels, cells] to [3, cells, channels].
Buffer<int32_t> channels_last(const Buffer<int32_t>& from, int64_t channels, int64_t cells) {
  Buffer<int32_t> to(from.size);
  for (int64_t k = 0; k < ORIENTATIONS; ++k)
    for (int64_t c = 0; c < channels; ++c)
      for (int64_t i = 0; i < cells; ++i) to[(k * cells + i) * channels + c] = from[(k * channels + c) * cells + i];
  return to;
}

}  // namespace

void SpatialModel::take(Weights& weights) {
  numbers = Buffer<float>(NUMBERS);
  std::memcpy(numbers.data, weights.take(NUMBERS), sizeof(float) * NUMBERS);
}

void SpatialModel::convert() {
  FileLayer layers[LAYERS];
  float* at = numbers.data;
  for (int64_t l = 0; l < LAYERS; ++l) {
    const int64_t inputs = l ? HIDDEN : NEIGHBORS, outputs = l < LAYERS - 1 ? HIDDEN : 2;
    for (int64_t i = 0; i < HIDDEN && l && l < LAYERS - 1; ++i) at[i * HIDDEN + i] += 1.0f;  // what skips the layer
    layers[l] = {at, at + inputs * outputs, inputs, outputs};
    at += (inputs + 1) * outputs;
  }
  network = IntegerNetwork(layers, LAYERS, nullptr, "a spatial model cannot be used: ");
}

int64_t Planes::integers() const {
  int64_t found = 0;
  for (int64_t s = 0; s < scales; ++s) found += ORIENTATIONS * channels * size[s] * size[s];
  return found;
}

void Planes::decode(Bytes data, const SpatialModel* models, const ExactTables& tables) {
  for (int64_t s = 0; s < scales; ++s) {
    values[s] = Buffer<int32_t>(ORIENTATIONS * channels * size[s] * size[s]);
    values[s].clear();
  }
  const bool is_first = data.left >= 2 && data.data[0] == 1 && data.data[1] == 0;
  is_first ? decode_version_1(data, models, tables) : decode_streams(data, models, tables);
  for (int64_t s = 0; s < scales; ++s) values[s] = channels_last(values[s], channels, size[s] * size[s]);
}

void Planes::decode_streams(Bytes data, const SpatialModel* models, const ExactTables& tables) {
  const auto version = static_cast<int64_t>(data.integer(2)), table_crc = static_cast<int64_t>(data.integer(4));
  tables.check(version == 2 ? tables.version : version, table_crc);
  const uint64_t crc = data.integer(4);
  const auto together = static_cast<int64_t>(data.varint(static_cast<uint64_t>(channels)));
  if (together < 1) refuse("a stream of no channels");
  int64_t count = 0;
  for (int64_t s = 0; s < scales; ++s)
    if (size[s]) count += ORIENTATIONS * ((channels + together - 1) / together);
  const StreamTable table(data, count, false);
  Buffer<splatwizard::PlaneStream> streams(count);
  Buffer<int64_t> bundles(count + 1);
  int64_t at = 0, bundle = 0, first = 0;  // a bundle: eight channels at most, of one plane
  for (int64_t s = 0; s < scales; ++s)
    for (int64_t k = 0; k < ORIENTATIONS && size[s]; ++k)
      for (int64_t c = 0; c < channels; c += together) {
        const int64_t some = channels - c < together ? channels - c : together;
        if (c == 0 || c + some - first > 8) bundles[bundle++] = at, first = c;
        streams[at++] = {s, k, c, some};
      }
  bundles[bundle++] = count;
  Buffer<double> weights(ORIENTATIONS * SpatialModel::NUMBERS);
  double* next = weights.data;
  for (int k = 0; k < ORIENTATIONS; ++k)
    for (int64_t l = 0; l < SpatialModel::LAYERS; ++l)
      for (const Buffer<double>& part : models[k].network.numbers[l]) {
        std::memcpy(next, part.data, sizeof(double) * static_cast<size_t>(part.size));
        next += part.size;
      }
  splatwizard::PlanesArgs args{};
  args.streams = streams.data, args.count = count;
  args.bundle = bundles.data, args.bundles_end = bundles.data + bundle;
  for (int64_t s = 0; s < scales; ++s) {
    args.planes[s] = values[s].data, args.channels[s] = channels;
    args.height[s] = args.width[s] = size[s];
  }
  args.weights = weights.data;
  refuse_damage(arch_native::decode_planes(tables.laplace.tables(),
                                           {table.data.data, table.sizes.data, table.offsets.data, count}, args, ALONE));
  uint32_t found = 0;
  for (int64_t s = 0; s < scales; ++s) found = crc32(values[s].data, 4 * values[s].size, found);
  if (found != crc) refuse(WRONG_CONTEXT);
}

// All planes as one stream: in each step what has the same column + 3 row, table by table.
void Planes::decode_version_1(Bytes data, const SpatialModel* models, const ExactTables& tables) {
  const TableFamily& family = tables.laplace;
  const auto version = static_cast<int64_t>(data.integer(2));
  tables.check(version, static_cast<int64_t>(data.integer(4)));
  const uint64_t crc = data.integer(4);
  const auto stored = static_cast<int64_t>(data.varint(8 * static_cast<uint64_t>(data.left)));
  const Bytes words = whole_words(data.take(data.length()));
  Escapes codes(data.take(data.left), stored);
  Buffer<int64_t> beyond(stored);
  for (int64_t i = 0; i < stored; ++i) beyond[i] = codes.beyond(0);
  codes.finish(false);
  arch_native::RangeReader reader(words.data, words.left);
  int64_t state[4], steps = 0, used = 0;
  const splatwizard::RangeSession session{words.data, words.left, state};
  session.store(reader);
  for (int64_t s = 0; s < scales; ++s)
    if (size[s] && size[s] + 3 * (size[s] - 1) > steps) steps = size[s] + 3 * (size[s] - 1);
  uint32_t found = 0;
  for (int64_t step = 0; step < steps; ++step) {
    const auto first_row = [&](int64_t s) { return step < size[s] ? 0 : (step - size[s] + 3) / 3; };
    const auto last_row = [&](int64_t s) { return step / 3 < size[s] ? step / 3 : size[s] - 1; };
    int64_t n = 0;
    for (int64_t s = 0; s < scales; ++s) {
      const int64_t rows = last_row(s) - first_row(s) + 1;
      n += rows > 0 ? rows * ORIENTATIONS * channels : 0;
    }
    if (n == 0) continue;
    Buffer<int32_t> centre(n), symbols(n);
    Buffer<int16_t> number(n);
    Buffer<int32_t*> cells(n);
    int64_t at = 0;
    for (int64_t s = 0; s < scales; ++s) {
      const int64_t rows = last_row(s) - first_row(s) + 1, side = size[s];
      if (rows <= 0) continue;
      Buffer<int64_t> neighbors(rows * channels * SpatialModel::NEIGHBORS), outputs(2 * rows * channels);
      for (int64_t k = 0; k < ORIENTATIONS; ++k) {
        int64_t* to = neighbors.data;
        for (int64_t c = 0; c < channels; ++c)
          for (int64_t row = first_row(s); row <= last_row(s); ++row) {
            const int64_t column = step - 3 * row;
            int32_t* plane = values[s].data + (k * channels + c) * side * side;
            cells[at + (to - neighbors.data) / SpatialModel::NEIGHBORS] = plane + row * side + column;
            for (int i = 0; i < SpatialModel::NEIGHBORS; ++i) {
              const int64_t y = row + DOWN[i], x = column + RIGHT[i];
              *to++ = y < 0 || x < 0 || x >= side ? 0 : int64_t{plane[y * side + x]} * 4096;
            }
          }
        models[k].network(rows * channels, neighbors.data, SpatialModel::NEIGHBORS, SpatialModel::NEIGHBORS, nullptr, 0,
                          0, outputs.data);
        for (int64_t i = 0; i < rows * channels; ++i, ++at) {
          int64_t level = (7215259165 - 288539 * outputs[2 * i + 1]) >> 28;
          level = level < 0 ? 0 : level > 63 ? 63 : level;
          const int64_t eighths = (8 * outputs[2 * i] + 2048) >> 12, whole = (eighths + 4) >> 3;
          centre[at] = static_cast<int32_t>(whole);
          number[at] = static_cast<int16_t>(8 * level + eighths + 4 - 8 * whole);
        }
      }
    }
    if (arch_native::range_entries(session, family.tables(), number.data, n, symbols.data)) refuse(DAMAGED_WORDS);
    const Buffer<int64_t> escaped = escaped_rows(symbols.data, number.data, n, family.radius.data);
    if (used + escaped.size > stored)
      refuse("more escapes are coded than stored: damaged data or a wrong context");
    bool too_large = false, beyond_planes = false;
    for (int64_t i = 0; i < escaped.size; ++i, ++used) {
      const int64_t row = escaped[i], radius = family.radius[number[row]];
      const int64_t offset = beyond[used] < 0 ? beyond[used] - radius : beyond[used] + radius;
      too_large |= offset >= int64_t{1} << 31 || -offset >= int64_t{1} << 31;
      symbols[row] = static_cast<int32_t>(offset + radius);
    }
    for (int64_t i = 0; i < n; ++i) {
      const int64_t value = int64_t{symbols[i]} - family.radius[number[i]] + centre[i];
      too_large |= value >= splatwizard::SYMBOL_LIMIT || value <= -splatwizard::SYMBOL_LIMIT;
      beyond_planes |= value >= PLANE_LIMIT || value <= -PLANE_LIMIT;
      *cells[i] = symbols[i] = static_cast<int32_t>(value);
    }
    if (too_large) refuse("a symbol is beyond 2^30: damaged data or a wrong context");
    found = crc32(symbols.data, 4 * n, found);
    if (beyond_planes) refuse("a value of a plane is beyond 2^24: damaged data or other models");
  }
  if (used != stored || found != crc) refuse(WRONG_CONTEXT);
}

void Planes::features(const int64_t* places, int64_t rows, int64_t* to) const {
  splatwizard::TriplaneArgs args{};
  args.places = places, args.rows = rows, args.out = to;
  args.scales = scales, args.channels = channels;
  for (int64_t s = 0; s < scales; ++s) args.planes[s] = values[s].data, args.size[s] = size[s];
  arch_native::triplane_features(args, ALONE);
}

}  // namespace swz
