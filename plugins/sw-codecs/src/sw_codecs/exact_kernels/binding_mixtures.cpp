// Registers the coding of numbers under mixtures as torch ops; checks what it is handed.
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <torch/library.h>

#include <cstring>
#include <tuple>

#include <splatwizard/torch_parallel.h>

#include "binding.h"
#include "mixtures.h"

namespace {

using at::Tensor;
using namespace splatwizard;

// Mixtures of n numbers: tables (below, escape: f64; first, radius: i32), order and width [n], shift and number [n, 2],
// weight [n]; i32 but number, which is i16.
MixtureArgs mixtures_of(at::TensorList tables, at::TensorList rows, const char* op) {
  TORCH_CHECK(tables.size() == 4 && rows.size() == 5, op, ": tables must be 4 and rows 5 tensors");
  for (size_t i = 0; i < 4; ++i) check(tables[i], i < 2 ? at::kDouble : at::kInt, 1, op, "tables");
  TORCH_CHECK(tables[1].numel() == 512 && tables[2].numel() == 512 && tables[3].numel() == 512, op,
              ": tables must be 512");
  const int64_t n = rows[0].numel();
  for (size_t i = 0; i < 5; ++i) {
    check(rows[i], i == 3 ? at::kShort : at::kInt, i == 2 || i == 3 ? 2 : 1, op, "rows");
    TORCH_CHECK(rows[i].size(0) == n && (rows[i].dim() == 1 || rows[i].size(1) == 2), op, ": rows differ in length");
  }
  const int32_t *order = rows[0].const_data_ptr<int32_t>(), *width = rows[1].const_data_ptr<int32_t>();
  const int16_t* number = rows[3].const_data_ptr<int16_t>();
  for (int64_t i = 0; i < n; ++i)
    TORCH_CHECK(order[i] >= 0 && order[i] < n && width[i] >= 1 && width[i] <= 1 << 16 && number[2 * i] >= 0 &&
                    number[2 * i] < 512 && number[2 * i + 1] >= 0 && number[2 * i + 1] < 512,
                op, ": row ", i, " is out of range");
  return {tables[0].const_data_ptr<double>(), tables[1].const_data_ptr<double>(), tables[2].const_data_ptr<int32_t>(),
          tables[3].const_data_ptr<int32_t>(), order, width, rows[2].const_data_ptr<int32_t>(), number,
          rows[4].const_data_ptr<int32_t>(), n};
}

// (entries [n] i32, status) of range-coded words.
std::tuple<Tensor, int64_t> decode_mixtures(at::TensorList tables, at::TensorList rows, const Tensor& words) {
  const char* op = "decode_mixtures";
  check(words, at::kByte, 1, op, "words");
  const MixtureArgs args = mixtures_of(tables, rows, op);
  Tensor entries = at::empty({args.n}, rows[0].options());
  const int32_t status = SW_SELECT(decode_mixtures)(args, words.const_data_ptr<uint8_t>(), words.numel(),
                                                    entries.mutable_data_ptr<int32_t>());
  return {entries, status};
}

// (centre, half-width, order [n]; shift, number [n, 2]; weight [n], status) of the numbers of a block, all i32 but
// number, which is i16. Of parts mean, scale, second mean, second scale, logit [rows, columns] and step [rows, 1] i64;
// multipliers [128], thresholds [63] and half-widths i64, radius [512] i32.
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, int64_t> mixture_rows(
    at::TensorList parts, const Tensor& multipliers, const Tensor& thresholds, const Tensor& radius,
    const Tensor& half_widths) {
  const char* op = "mixture_rows";
  TORCH_CHECK(parts.size() == 6, op, ": six parts");
  MixtureRowsArgs args{};
  args.rows = parts[0].size(0);
  args.columns = parts[0].size(1);
  for (size_t i = 0; i < 6; ++i) {
    const Tensor& each = parts[i];
    TORCH_CHECK(each.is_cpu() && each.scalar_type() == at::kLong && each.dim() == 2 && each.size(0) == args.rows &&
                    each.size(1) == (i < 5 ? args.columns : 1) && (each.size(1) < 2 || each.stride(1) == 1),
                op, ": parts must be int64 [n, columns] on the CPU");
    args.stride[i] = each.stride(0);
  }
  for (size_t g = 0; g < 2; ++g) {
    args.mean[g] = parts[2 * g].const_data_ptr<int64_t>();
    args.scale[g] = parts[2 * g + 1].const_data_ptr<int64_t>();
  }
  args.logit = parts[4].const_data_ptr<int64_t>();
  args.step = parts[5].const_data_ptr<int64_t>();
  check(multipliers, at::kLong, 1, op, "multipliers");
  check(thresholds, at::kLong, 1, op, "thresholds");
  check(half_widths, at::kLong, 1, op, "half_widths");
  check(radius, at::kInt, 1, op, "radius");
  const int64_t n = args.rows * args.columns;
  TORCH_CHECK(multipliers.numel() == 128 && thresholds.numel() == 63 && radius.numel() == 512 &&
                  half_widths.numel() >= 1 && half_widths.numel() <= 256 && n < int64_t{1} << 31,
              op, ": shapes do not fit");
  args.multipliers = multipliers.const_data_ptr<int64_t>();
  args.thresholds = thresholds.const_data_ptr<int64_t>();
  args.radius = radius.const_data_ptr<int32_t>();
  args.half_widths = half_widths.const_data_ptr<int64_t>();
  args.widths = half_widths.numel();
  const auto narrow = radius.options();
  Tensor centre = at::empty({n}, narrow), width = at::empty({n}, narrow), order = at::empty({n}, narrow);
  Tensor shift = at::empty({n, 2}, narrow), number = at::empty({n, 2}, narrow.dtype(at::kShort));
  Tensor weight = at::empty({n}, narrow);
  args.centre = centre.mutable_data_ptr<int32_t>();
  args.width = width.mutable_data_ptr<int32_t>();
  args.order = order.mutable_data_ptr<int32_t>();
  args.shift = shift.mutable_data_ptr<int32_t>();
  args.number = number.mutable_data_ptr<int16_t>();
  args.weight = weight.mutable_data_ptr<int32_t>();
  const int32_t status = SW_SELECT(mixture_rows)(args, torch_parallel());
  return {centre, width, order, shift, number, weight, status};
}

// Range-coded words, u8, of entries [n] i32.
Tensor encode_mixtures(at::TensorList tables, at::TensorList rows, const Tensor& entries) {
  const char* op = "encode_mixtures";
  check(entries, at::kInt, 1, op, "entries");
  const MixtureArgs args = mixtures_of(tables, rows, op);
  TORCH_CHECK(entries.numel() == args.n, op, ": entries differ in length");
  const int32_t* entry = entries.const_data_ptr<int32_t>();
  for (int64_t i = 0; i < args.n; ++i)
    TORCH_CHECK(entry[i] >= 0 && entry[i] <= 2 * args.width[i] + 1, op, ": entry ", i, " is out of range");
  Tensor words = at::empty({4 * (args.n + 2)}, entries.options().dtype(at::kByte));
  const int64_t bytes = SW_SELECT(encode_mixtures)(args, entry, words.mutable_data_ptr<uint8_t>());
  Tensor found = at::empty({bytes}, words.options());
  if (bytes > 0) std::memcpy(found.mutable_data_ptr<uint8_t>(), words.const_data_ptr<uint8_t>(), static_cast<size_t>(bytes));
  return found;
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sw_codecs_exact, m) {
  m.def("decode_mixtures(Tensor[] tables, Tensor[] rows, Tensor words) -> (Tensor, int)");
  m.def("mixture_rows(Tensor[] parts, Tensor multipliers, Tensor thresholds, Tensor radius, Tensor half_widths)"
        " -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, int)");
  m.def("encode_mixtures(Tensor[] tables, Tensor[] rows, Tensor entries) -> Tensor");
  m.impl("decode_mixtures", c10::DispatchKey::CPU, TORCH_FN(decode_mixtures));
  m.impl("mixture_rows", c10::DispatchKey::CPU, TORCH_FN(mixture_rows));
  m.impl("encode_mixtures", c10::DispatchKey::CPU, TORCH_FN(encode_mixtures));
}
