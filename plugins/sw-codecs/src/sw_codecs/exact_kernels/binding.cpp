// Registers the coding of the exact mode as torch ops; checks what it is handed.
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/zeros.h>
#include <torch/library.h>

#include <algorithm>
#include <cstring>
#include <optional>
#include <tuple>
#include <vector>

#include <splatwizard/torch_parallel.h>

#include "binding.h"
#include "range_coded.h"

namespace {

using at::Tensor;
using namespace splatwizard;

Tables tables_of(at::TensorList t, const char* op) {
  TORCH_CHECK(t.size() == 4, op, ": tables must be shares, first, radius and bucket");
  for (int i = 0; i < 3; ++i) check(t[i], at::kInt, 1, op, "tables");
  check(t[3], at::kShort, 2, op, "bucket");
  TORCH_CHECK(t[1].numel() == 512 && t[2].numel() == 512 && t[3].numel() == 512 * 256, op, ": tables must be 512");
  return {t[0].const_data_ptr<int32_t>(), t[1].const_data_ptr<int32_t>(), t[2].const_data_ptr<int32_t>(),
          reinterpret_cast<const uint16_t*>(t[3].const_data_ptr<int16_t>())};
}

// Where each stream begins, given their sizes [count, 3]; `bytes` must be all of them.
std::vector<int64_t> offsets_of(const Tensor& sizes, int64_t bytes, const char* op) {
  std::vector<int64_t> offsets;
  int64_t at = 0;
  const int64_t* table = sizes.const_data_ptr<int64_t>();
  for (int64_t s = 0; s < sizes.size(0); ++s) {
    const int64_t words = table[3 * s + 1], escapes = table[3 * s + 2];
    TORCH_CHECK(words >= 0 && escapes >= 0 && words <= bytes - at && escapes <= bytes - at - words, op,
                ": streams end behind the data");
    offsets.push_back(at);
    at += words + escapes;
  }
  TORCH_CHECK(at == bytes, op, ": data behind the last stream");
  return offsets;
}

// A place for each stream, given how many symbols it has.
std::vector<int64_t> places_of(const std::vector<int64_t>& counts, int64_t& bytes) {
  std::vector<int64_t> offsets;
  bytes = 0;
  for (const int64_t count : counts) {
    offsets.push_back(bytes);
    bytes += most_bytes(count);
  }
  return offsets;
}

// The streams without the room between them.
Tensor joined(const Tensor& data, const std::vector<int64_t>& offsets, const Tensor& sizes) {
  const int64_t* table = sizes.const_data_ptr<int64_t>();
  int64_t bytes = 0;
  for (size_t s = 0; s < offsets.size(); ++s) bytes += table[3 * s + 1] + table[3 * s + 2];
  Tensor found = at::empty({bytes}, data.options());
  uint8_t* to = found.mutable_data_ptr<uint8_t>();
  const uint8_t* from = data.const_data_ptr<uint8_t>();
  for (size_t s = 0; s < offsets.size(); ++s) {
    const auto size = static_cast<size_t>(table[3 * s + 1] + table[3 * s + 2]);
    if (size > 0) std::memcpy(to, from + offsets[s], size);
    to += size;
  }
  return found;
}

// Numbers that are present, and the number of the first one of each row, if not all are.
int64_t starts_of(const std::optional<Tensor>& present, int64_t rows, int64_t columns, std::vector<int64_t>& start,
                  const char* op) {
  if (!present.has_value()) return rows * columns;
  check(*present, at::kBool, 2, op, "present");
  TORCH_CHECK(present->size(0) == rows && present->size(1) == columns, op, ": present must be [rows, columns]");
  const bool* there = present->const_data_ptr<bool>();
  int64_t count = 0;
  start.reserve(static_cast<size_t>(rows));
  for (int64_t row = 0; row < rows; ++row) {
    start.push_back(count);
    for (int64_t c = 0; c < columns; ++c) count += there[row * columns + c];
  }
  return count;
}

// (integer parts [m] i32, table numbers [m] i16, status) of the present numbers.
std::tuple<Tensor, Tensor, int64_t> lattice(const Tensor& mean, const Tensor& scale, const Tensor& multiplier,
                                            const std::optional<Tensor>& present, const Tensor& thresholds) {
  const char* op = "lattice";
  for (const Tensor& each : {mean, scale, multiplier})
    TORCH_CHECK(each.is_cpu() && each.scalar_type() == at::kLong && each.dim() == 2 && each.size(0) == mean.size(0) &&
                    (each.size(1) < 2 || each.stride(1) == 1),
                op, ": mean, scale and multiplier must be int64 [n, columns] on the CPU");
  TORCH_CHECK(scale.sizes() == mean.sizes() && multiplier.size(1) == 1, op, ": shapes do not fit");
  check(thresholds, at::kLong, 1, op, "thresholds");
  TORCH_CHECK(thresholds.numel() == 63, op, ": thresholds must be 63");
  const int64_t rows = mean.size(0), columns = mean.size(1);
  std::vector<int64_t> start;
  const int64_t count = starts_of(present, rows, columns, start, op);
  Tensor centre = at::empty({count}, mean.options().dtype(at::kInt));
  Tensor number = at::empty({count}, mean.options().dtype(at::kShort));
  const LatticeArgs args{mean.const_data_ptr<int64_t>(),
                         scale.const_data_ptr<int64_t>(),
                         multiplier.const_data_ptr<int64_t>(),
                         mean.stride(0),
                         scale.stride(0),
                         multiplier.stride(0),
                         present.has_value() ? reinterpret_cast<const uint8_t*>(present->const_data_ptr<bool>()) : nullptr,
                         start.data(),
                         rows,
                         columns,
                         thresholds.const_data_ptr<int64_t>(),
                         centre.mutable_data_ptr<int32_t>(),
                         number.mutable_data_ptr<int16_t>()};
  const int32_t status = SW_SELECT(lattice)(args, torch_parallel());
  return {centre, number, status};
}

// (centre [m], number [m]) of the present ones of [n, columns].
std::tuple<Tensor, Tensor> present_rows(const Tensor& centre, const Tensor& number, const Tensor& present) {
  const char* op = "present_rows";
  check(centre, at::kInt, 2, op, "centre");
  check(number, at::kShort, 2, op, "number");
  TORCH_CHECK(number.sizes() == centre.sizes(), op, ": centre and number differ in shape");
  std::vector<int64_t> start;
  const int64_t count = starts_of(present, centre.size(0), centre.size(1), start, op);
  Tensor to_centre = at::empty({count}, centre.options()), to_number = at::empty({count}, number.options());
  const PresentArgs args{centre.const_data_ptr<int32_t>(),
                        number.const_data_ptr<int16_t>(),
                        reinterpret_cast<const uint8_t*>(present.const_data_ptr<bool>()),
                        start.data(),
                        centre.size(0),
                        centre.size(1),
                        to_centre.mutable_data_ptr<int32_t>(),
                        to_number.mutable_data_ptr<int16_t>()};
  SW_SELECT(present_rows)(args, torch_parallel());
  return {to_centre, to_number};
}

void check_lattice(const Tensor& centre, const Tensor& number, const char* op) {
  check(centre, at::kInt, 1, op, "centre");
  check(number, at::kShort, 1, op, "number");
  TORCH_CHECK(centre.numel() == number.numel(), op, ": centre and number differ in length");
}

int64_t streams_of(int64_t symbols) { return (symbols + STREAM - 1) / STREAM; }

// (symbols [n] i32, status) of `data`, whose streams have `sizes` [streams, 3]: anything, bytes of words, of escapes.
std::tuple<Tensor, int64_t> decode_streams(at::TensorList tables, const Tensor& data, const Tensor& sizes,
                                           const Tensor& centre, const Tensor& number) {
  const char* op = "decode_streams";
  check(data, at::kByte, 1, op, "data");
  check(sizes, at::kLong, 2, op, "sizes");
  check_lattice(centre, number, op);
  const int64_t count = centre.numel();
  TORCH_CHECK(sizes.size(0) == streams_of(count) && sizes.size(1) == 3, op, ": sizes must be [streams, 3]");
  const std::vector<int64_t> offsets = offsets_of(sizes, data.numel(), op);
  Tensor symbols = at::empty({count}, centre.options());
  const Streams streams{data.const_data_ptr<uint8_t>(), sizes.const_data_ptr<int64_t>(), offsets.data(), sizes.size(0)};
  const int32_t status = SW_SELECT(decode_streams)(tables_of(tables, op), streams, centre.const_data_ptr<int32_t>(),
                                                   number.const_data_ptr<int16_t>(), count,
                                                   symbols.mutable_data_ptr<int32_t>(), torch_parallel());
  return {symbols, status};
}

// (data, sizes) as above, of symbols [n] i32.
std::tuple<Tensor, Tensor> encode_streams(at::TensorList tables, const Tensor& symbols, const Tensor& centre,
                                          const Tensor& number) {
  const char* op = "encode_streams";
  check(symbols, at::kInt, 1, op, "symbols");
  check_lattice(centre, number, op);
  const int64_t count = symbols.numel();
  TORCH_CHECK(centre.numel() == count, op, ": symbols and centre differ in length");
  std::vector<int64_t> counts;
  for (int64_t at = 0; at < count; at += STREAM) counts.push_back(std::min(STREAM, count - at));
  int64_t bytes = 0;
  const std::vector<int64_t> offsets = places_of(counts, bytes);
  Tensor data = at::empty({bytes}, symbols.options().dtype(at::kByte));
  Tensor sizes = at::zeros({static_cast<int64_t>(counts.size()), 3}, symbols.options().dtype(at::kLong));
  const Sinks sinks{data.mutable_data_ptr<uint8_t>(), offsets.data(), sizes.mutable_data_ptr<int64_t>(), sizes.size(0)};
  SW_SELECT(encode_streams)(tables_of(tables, op), sinks, centre.const_data_ptr<int32_t>(),
                            number.const_data_ptr<int16_t>(), count, symbols.const_data_ptr<int32_t>(),
                            torch_parallel());
  return {joined(data, offsets, sizes), sizes};
}

// (nodes [m] i64, occupancies u8 of all levels, nodes of each level and at the end [levels + 1] i64, status) of
// range-coded words under counts [levels, 4, 255] i64, none empty; no level has more than `points` nodes.
std::tuple<Tensor, Tensor, Tensor, int64_t> decode_octree(const Tensor& words, const Tensor& counts, int64_t points) {
  const char* op = "decode_octree";
  check(words, at::kByte, 1, op, "words");
  check(counts, at::kLong, 3, op, "counts");
  const int64_t depth = counts.size(0);
  TORCH_CHECK(counts.size(1) == 4 && counts.size(2) == 255 && depth <= 21 && points >= 1 && points < int64_t{1} << 40,
              op, ": counts must be [levels, 4, 255]");
  Tensor nodes = at::empty({points}, counts.options());
  Tensor occupancies = at::empty({depth * points}, words.options());
  Tensor sizes = at::zeros({depth + 1}, counts.options());
  const int32_t status = SW_SELECT(decode_octree)(
      {words.const_data_ptr<uint8_t>(), words.numel(), depth, points, counts.const_data_ptr<int64_t>()},
      nodes.mutable_data_ptr<int64_t>(), occupancies.mutable_data_ptr<uint8_t>(), sizes.mutable_data_ptr<int64_t>());
  return {nodes, occupancies, sizes, status};
}

// (bits [count] i32, status) of range-coded words; `zeros` of 2^24 is the share of 0.
std::tuple<Tensor, int64_t> decode_bits(const Tensor& words, int64_t zeros, int64_t count) {
  const char* op = "decode_bits";
  check(words, at::kByte, 1, op, "words");
  TORCH_CHECK(zeros >= 1 && zeros < 1 << 24 && count >= 0, op, ": zeros must be 1..2^24 - 1");
  Tensor bits = at::empty({count}, words.options().dtype(at::kInt));
  const int32_t status =
      SW_SELECT(decode_bits)(words.const_data_ptr<uint8_t>(), words.numel(), static_cast<uint32_t>(zeros), count,
                             bits.mutable_data_ptr<int32_t>());
  return {bits, status};
}

// Symbols [m] i32 as integers [n, C] i64, 0 where they are not present; values [n, C] f32 become integer * step.
Tensor put_values(const Tensor& symbols, const std::optional<Tensor>& present, const Tensor& step,
                  const Tensor& values) {
  const char* op = "put_values";
  check(symbols, at::kInt, 1, op, "symbols");
  check(step, at::kDouble, 2, op, "step");
  TORCH_CHECK(values.is_cpu() && values.scalar_type() == at::kFloat && values.dim() == 2 &&
                  (values.size(1) < 2 || values.stride(1) == 1) && step.size(0) == values.size(0) && step.size(1) == 1,
              op, ": values must be f32 [n, columns] on the CPU, with a step for each row");
  std::vector<int64_t> start;
  const int64_t rows = values.size(0), columns = values.size(1);
  TORCH_CHECK(starts_of(present, rows, columns, start, op) == symbols.numel(), op, ": another number of symbols");
  Tensor integers = at::empty({rows, columns}, symbols.options().dtype(at::kLong));
  const PutArgs args{symbols.const_data_ptr<int32_t>(),
                     present.has_value() ? reinterpret_cast<const uint8_t*>(present->const_data_ptr<bool>()) : nullptr,
                     start.data(),
                     step.const_data_ptr<double>(),
                     rows,
                     columns,
                     values.mutable_data_ptr<float>(),
                     values.stride(0),
                     integers.mutable_data_ptr<int64_t>()};
  SW_SELECT(put_values)(args, torch_parallel());
  return integers;
}

// The streams of planes: rows (scale, orientation, first channel, channels), as the file has them.
struct PlaneTask {
  std::vector<PlaneStream> streams;
  std::vector<int64_t> bundles, symbols;
  PlanesArgs args{};

  PlaneTask(at::TensorList planes, const Tensor& parts, const Tensor& weights, const char* op) {
    check(parts, at::kLong, 2, op, "parts");
    TORCH_CHECK(!planes.empty() && planes.size() <= 4 && parts.size(1) == 4, op, ": one to four scales of planes");
    const int64_t orientations = planes[0].size(0);
    for (size_t i = 0; i < planes.size(); ++i) {
      check(planes[i], at::kInt, 4, op, "planes");
      TORCH_CHECK(planes[i].size(0) == orientations, op, ": scales differ in orientations");
      args.planes[i] = planes[i].mutable_data_ptr<int32_t>();
      args.channels[i] = planes[i].size(1);
      args.height[i] = planes[i].size(2);
      args.width[i] = planes[i].size(3);
    }
    TORCH_CHECK(weights.dim() == 2 && weights.size(0) == orientations &&
                    weights.size(1) == 1058,
                op, ": weights must be [orientations, 1058]");
    check(weights, at::kDouble, 2, op, "weights");
    args.weights = weights.const_data_ptr<double>();
    const int64_t* row = parts.const_data_ptr<int64_t>();
    for (int64_t s = 0; s < parts.size(0); ++s, row += 4) {
      TORCH_CHECK(row[0] >= 0 && row[0] < static_cast<int64_t>(planes.size()) && row[1] >= 0 && row[1] < orientations &&
                      row[2] >= 0 && row[3] >= 1 && row[2] + row[3] <= args.channels[row[0]],
                  op, ": stream ", s, " lies outside the planes");
      const PlaneStream stream{row[0], row[1], row[2], row[3]};
      symbols.push_back(stream.channels * args.height[stream.scale] * args.width[stream.scale]);
      bool joins = false;
      if (!streams.empty()) {
        const PlaneStream &last = streams.back(), &first = streams[static_cast<size_t>(bundles.back())];
        joins = last.scale == stream.scale && last.orientation == stream.orientation &&
                last.channel + last.channels == stream.channel &&
                stream.channel + stream.channels - first.channel <= 8;
      }
      if (!joins) bundles.push_back(s);
      streams.push_back(stream);
    }
    bundles.push_back(parts.size(0));
    args.streams = streams.data();
    args.count = parts.size(0);
    args.bundle = bundles.data();
    args.bundles_end = bundles.data() + bundles.size();
  }
};

// Fills planes [K, C, H, W] i32 of each scale; the status.
int64_t decode_planes(at::TensorList tables, const Tensor& data, const Tensor& sizes, at::TensorList planes,
                      const Tensor& parts, const Tensor& weights) {
  const char* op = "decode_planes";
  check(data, at::kByte, 1, op, "data");
  check(sizes, at::kLong, 2, op, "sizes");
  TORCH_CHECK(sizes.size(0) == parts.size(0) && sizes.size(1) == 3, op, ": sizes must be [streams, 3]");
  const PlaneTask task(planes, parts, weights, op);
  const std::vector<int64_t> offsets = offsets_of(sizes, data.numel(), op);
  const Streams streams{data.const_data_ptr<uint8_t>(), sizes.const_data_ptr<int64_t>(), offsets.data(), sizes.size(0)};
  return SW_SELECT(decode_planes)(tables_of(tables, op), streams, task.args, torch_parallel());
}

// (data, sizes) of planes.
std::tuple<Tensor, Tensor> encode_planes(at::TensorList tables, at::TensorList planes, const Tensor& parts,
                                         const Tensor& weights) {
  const char* op = "encode_planes";
  const PlaneTask task(planes, parts, weights, op);
  int64_t bytes = 0;
  const std::vector<int64_t> offsets = places_of(task.symbols, bytes);
  Tensor data = at::empty({bytes}, parts.options().dtype(at::kByte));
  Tensor sizes = at::zeros({parts.size(0), 3}, parts.options());
  const Sinks sinks{data.mutable_data_ptr<uint8_t>(), offsets.data(), sizes.mutable_data_ptr<int64_t>(), sizes.size(0)};
  SW_SELECT(encode_planes)(tables_of(tables, op), sinks, task.args, torch_parallel());
  return {joined(data, offsets, sizes), sizes};
}

}  // namespace

TORCH_LIBRARY(sw_codecs_exact, m) {
  m.def("lattice(Tensor mean, Tensor scale, Tensor multiplier, Tensor? present, Tensor thresholds)"
        " -> (Tensor, Tensor, int)");
  m.def("decode_streams(Tensor[] tables, Tensor data, Tensor sizes, Tensor centre, Tensor number) -> (Tensor, int)");
  m.def("encode_streams(Tensor[] tables, Tensor symbols, Tensor centre, Tensor number) -> (Tensor, Tensor)");
  m.def("decode_bits(Tensor words, int zeros, int count) -> (Tensor, int)");
  m.def("decode_octree(Tensor words, Tensor counts, int points) -> (Tensor, Tensor, Tensor, int)");
  m.def("put_values(Tensor symbols, Tensor? present, Tensor step, Tensor(a!) values) -> Tensor");
  m.def("present_rows(Tensor centre, Tensor number, Tensor present) -> (Tensor, Tensor)");
  m.def("decode_planes(Tensor[] tables, Tensor data, Tensor sizes, Tensor(a!)[] planes, Tensor parts, Tensor weights)"
        " -> int");
  m.def("encode_planes(Tensor[] tables, Tensor[] planes, Tensor parts, Tensor weights) -> (Tensor, Tensor)");
  m.impl("lattice", c10::DispatchKey::CPU, TORCH_FN(lattice));
  m.impl("decode_streams", c10::DispatchKey::CPU, TORCH_FN(decode_streams));
  m.impl("encode_streams", c10::DispatchKey::CPU, TORCH_FN(encode_streams));
  m.impl("decode_bits", c10::DispatchKey::CPU, TORCH_FN(decode_bits));
  m.impl("decode_octree", c10::DispatchKey::CPU, TORCH_FN(decode_octree));
  m.impl("put_values", c10::DispatchKey::CPU, TORCH_FN(put_values));
  m.impl("present_rows", c10::DispatchKey::CPU, TORCH_FN(present_rows));
  m.impl("decode_planes", c10::DispatchKey::CPU, TORCH_FN(decode_planes));
  m.impl("encode_planes", c10::DispatchKey::CPU, TORCH_FN(encode_planes));
}
