// Rows of anchors in a training step as torch ops, on the current stream. On CUDA alone.
#include <torch/library.h>

TORCH_LIBRARY_FRAGMENT(sw_anchors, m) {
  // Rows [v,...] of tensors [n,...], into the first rows of others or into new ones; rows put among `count` zeros.
  m.def("load_rows(Tensor rows, Tensor[] sources, Tensor(a!)[] into) -> ()");
  m.def("take_rows(Tensor rows, Tensor[] sources) -> Tensor[]");
  m.def("scatter_rows(Tensor rows, Tensor[] sources, int count) -> Tensor[]");
  // Rows i of sources are added to rows[i] of others.
  m.def("add_rows(Tensor rows, Tensor[] sources, Tensor(a!)[] into) -> ()");
  // Values, masks, whether kept; gradients by features, log_scales, offsets, logits and, if they learn, steps.
  m.def("row_values(Tensor features, Tensor log_scales, Tensor offsets, Tensor logits, Tensor? weights, Tensor? valid,"
        " Tensor? noise, Tensor? steps, float threshold) -> (Tensor, Tensor, Tensor)");
  m.def("row_values_backward(Tensor features, Tensor log_scales, Tensor offsets, Tensor logits, Tensor? weights,"
        " Tensor? valid, Tensor? noise, Tensor? steps, Tensor?[] slopes, bool steps_learn) -> Tensor[]");
  // Bits [s,3], and derivatives of their sum by x, mean, scale, steps and masks.
  m.def("sample_bits(Tensor x, Tensor mean, Tensor scale, Tensor steps, Tensor counted, Tensor masks, float p_min,"
        " float smallest_scale) -> Tensor[]");
}

#ifdef SW_WITH_CUDA

#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/zeros.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>

#include <limits>
#include <optional>
#include <tuple>
#include <vector>

#include "cuda/rows.h"

namespace {

using at::Tensor;
using namespace sw_anchors;

void check(const Tensor& t, const char* name, const Tensor& like, at::IntArrayRef shape) {
  TORCH_CHECK(t.scalar_type() == at::kFloat && t.is_contiguous() && t.device() == like.device() && t.sizes() == shape,
              "sw_anchors: ", name, " must be contiguous float32 ", shape, " on ", like.device(), ", got ",
              t.toString(), " ", t.sizes(), " on ", t.device());
}

void check_rows(const Tensor& rows, const std::vector<Tensor>& tensors) {
  TORCH_CHECK(rows.dim() == 1 && rows.scalar_type() == at::kLong && rows.is_contiguous(),
              "sw_anchors: rows must be a contiguous int64 vector");
  TORCH_CHECK(tensors.size() <= size_t(kTensors), "sw_anchors: at most ", kTensors, " tensors are taken");
  for (const Tensor& t : tensors)
    TORCH_CHECK(t.dim() > 0 && t.element_size() == 4 && t.device() == rows.device(),
                "sw_anchors: tensors must be of 4 bytes a number on ", rows.device());
}

int64_t words_of(const Tensor& t) {
  int64_t words = 1;
  for (int64_t i = 1; i < t.dim(); ++i) words *= t.size(i);
  return words;
}

// Words between rows of a tensor whose rows are without gaps.
int64_t row_of(const Tensor& t) {
  if (t.is_contiguous()) return words_of(t);
  TORCH_CHECK(t.dim() == 2 && t.stride(1) == 1, "sw_anchors: rows of a tensor have gaps");
  return t.stride(0);
}

// Copies between rows of `sources` and `targets`, of the same shape but for the number of rows.
RowCopies copies_of(const std::vector<Tensor>& sources, const std::vector<Tensor>& targets) {
  RowCopies copies{};
  for (size_t i = 0; i < sources.size(); ++i) {
    const int64_t words = words_of(sources[i]);
    TORCH_CHECK(words == words_of(targets[i]) && copies.words + words < std::numeric_limits<int>::max(),
                "sw_anchors: rows of sources and targets differ in size");
    copies.words += int(words), copies.last[i] = copies.words;
    copies.from[i] = static_cast<const uint32_t*>(sources[i].const_data_ptr());
    copies.to[i] = static_cast<uint32_t*>(targets[i].mutable_data_ptr());
    copies.from_row[i] = row_of(sources[i]), copies.to_row[i] = row_of(targets[i]);
  }
  return copies;
}

void load_rows(const Tensor& rows, const std::vector<Tensor>& sources, const std::vector<Tensor>& into) {
  check_rows(rows, sources), check_rows(rows, into);
  TORCH_CHECK(sources.size() == into.size(), "sw_anchors: as many sources as targets are needed");
  for (const Tensor& t : into) TORCH_CHECK(t.size(0) >= rows.size(0), "sw_anchors: a target has too few rows");
  const c10::cuda::CUDAGuard guard(rows.device());
  cuda::gather(copies_of(sources, into), rows.const_data_ptr<int64_t>(), rows.size(0),
               c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
}

std::vector<Tensor> take_rows(const Tensor& rows, const std::vector<Tensor>& sources) {
  check_rows(rows, sources);
  const c10::cuda::CUDAGuard guard(rows.device());
  std::vector<Tensor> found;
  for (const Tensor& source : sources) {
    std::vector<int64_t> shape = source.sizes().vec();
    shape[0] = rows.size(0);
    found.push_back(at::empty(shape, source.options().requires_grad(false)));
  }
  cuda::gather(copies_of(sources, found), rows.const_data_ptr<int64_t>(), rows.size(0),
               c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found;
}

std::vector<Tensor> scatter_rows(const Tensor& rows, const std::vector<Tensor>& sources, int64_t count) {
  check_rows(rows, sources);
  const c10::cuda::CUDAGuard guard(rows.device());
  // In one allocation: cleared one by one they would be a launch each. Pieces start at multiples of 128 bytes.
  std::vector<int64_t> starts;
  int64_t total = 0;
  for (const Tensor& source : sources) {
    TORCH_CHECK(source.scalar_type() == at::kFloat && source.size(0) >= rows.size(0),
                "sw_anchors: float32 tensors with a row for each index are scattered");
    starts.push_back(total);
    total += (count * words_of(source) + 31) / 32 * 32;
  }
  const Tensor all = at::zeros({total}, rows.options().dtype(at::kFloat));
  std::vector<Tensor> found;
  for (size_t i = 0; i < sources.size(); ++i) {
    std::vector<int64_t> shape = sources[i].sizes().vec();
    shape[0] = count;
    found.push_back(all.narrow(0, starts[i], count * words_of(sources[i])).view(shape));
  }
  cuda::scatter(copies_of(sources, found), rows.const_data_ptr<int64_t>(), rows.size(0),
                c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found;
}

void add_rows(const Tensor& rows, const std::vector<Tensor>& sources, const std::vector<Tensor>& into) {
  check_rows(rows, sources), check_rows(rows, into);
  TORCH_CHECK(sources.size() == into.size(), "sw_anchors: as many sources as targets are needed");
  for (const Tensor& t : sources)
    TORCH_CHECK(t.scalar_type() == at::kFloat && t.size(0) == rows.size(0),
                "sw_anchors: float32 tensors with a row for each index are added");
  for (const Tensor& t : into)
    TORCH_CHECK(t.scalar_type() == at::kFloat, "sw_anchors: rows are added to float32 tensors");
  const c10::cuda::CUDAGuard guard(rows.device());
  cuda::add(copies_of(sources, into), rows.const_data_ptr<int64_t>(), rows.size(0),
            c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
}

Rows rows_of(const Tensor& features, const Tensor& log_scales, const Tensor& offsets, const Tensor& logits,
             const std::optional<Tensor>& weights, const std::optional<Tensor>& valid,
             const std::optional<Tensor>& noise, const std::optional<Tensor>& steps, double threshold) {
  TORCH_CHECK(features.dim() == 2 && logits.dim() == 2, "sw_anchors: features must be [c,f], logits [c,k]");
  const int64_t c = features.size(0), f = features.size(1), k = logits.size(1);
  check(features, "features", features, {c, f});
  check(log_scales, "log_scales", features, {c, 6});
  check(offsets, "offsets", features, {c, 3 * k});
  check(logits, "logits", features, {c, k});
  if (weights.has_value()) check(*weights, "weights", features, {c, 1});
  if (valid.has_value()) check(*valid, "valid", features, {});
  TORCH_CHECK(noise.has_value() == steps.has_value(), "sw_anchors: noise and steps come together");
  Rows from{c, int(f), int(k), features.const_data_ptr<float>(), log_scales.const_data_ptr<float>(),
            offsets.const_data_ptr<float>(), logits.const_data_ptr<float>(),
            weights.has_value() ? weights->const_data_ptr<float>() : nullptr,
            valid.has_value() ? valid->const_data_ptr<float>() : nullptr, nullptr, nullptr, 0, float(threshold)};
  if (noise.has_value()) {
    check(*noise, "noise", features, {c * (f + 6 + 3 * k)});
    check(*steps, "steps", features, {steps->size(0) == 1 ? 1 : c, kGroups});
    from.noise = noise->const_data_ptr<float>(), from.steps = steps->const_data_ptr<float>();
    from.step_row = steps->size(0) == c ? kGroups : 0;
  }
  return from;
}

std::tuple<Tensor, Tensor, Tensor> row_values(const Tensor& features, const Tensor& log_scales, const Tensor& offsets,
                                              const Tensor& logits, const std::optional<Tensor>& weights,
                                              const std::optional<Tensor>& valid, const std::optional<Tensor>& noise,
                                              const std::optional<Tensor>& steps, double threshold) {
  const Rows from = rows_of(features, log_scales, offsets, logits, weights, valid, noise, steps, threshold);
  const c10::cuda::CUDAGuard guard(features.device());
  const auto real = features.options().requires_grad(false);
  Tensor values = at::empty({from.count, from.features + 6 + 3 * from.offsets}, real);
  Tensor masks = at::empty({from.count, from.offsets}, real), kept = at::empty({from.count}, real);
  cuda::values(from, values.mutable_data_ptr<float>(), masks.mutable_data_ptr<float>(), kept.mutable_data_ptr<float>(),
               c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return {values, masks, kept};
}

Piece piece_of(const std::optional<Tensor>& slope, int64_t rows, int64_t columns) {
  if (!slope.has_value() || !slope->defined()) return {nullptr, 0};
  TORCH_CHECK(slope->is_cuda() && slope->scalar_type() == at::kFloat && slope->dim() == 2 && slope->size(0) == rows &&
                  slope->size(1) == columns && (columns <= 1 || slope->stride(1) == 1),
              "sw_anchors: a gradient must be float32 [", rows, ",", columns, "] with rows without gaps");
  return {slope->const_data_ptr<float>(), slope->stride(0)};
}

std::vector<Tensor> row_values_backward(const Tensor& features, const Tensor& log_scales, const Tensor& offsets,
                                        const Tensor& logits, const std::optional<Tensor>& weights,
                                        const std::optional<Tensor>& valid, const std::optional<Tensor>& noise,
                                        const std::optional<Tensor>& steps,
                                        const c10::List<std::optional<Tensor>>& slopes, bool steps_learn) {
  const Rows from = rows_of(features, log_scales, offsets, logits, weights, valid, noise, steps, 0.0);
  TORCH_CHECK(slopes.size() == 5, "sw_anchors: five gradients are needed");
  TORCH_CHECK(!steps_learn || from.step_row > 0, "sw_anchors: steps that learn are one for each row");
  const int64_t c = from.count, f = from.features, k = from.offsets;
  const RowSlopes by{piece_of(slopes.get(0), c, f + 6 + 3 * k),
                     {piece_of(slopes.get(1), c, f), piece_of(slopes.get(2), c, 6), piece_of(slopes.get(3), c, 3 * k)},
                     piece_of(slopes.get(4), c, k)};
  const c10::cuda::CUDAGuard guard(features.device());
  const auto real = features.options().requires_grad(false);
  std::vector<Tensor> found = {at::empty({c, f}, real), at::empty({c, 6}, real), at::empty({c, 3 * k}, real),
                               at::empty({c, k}, real)};
  if (steps_learn) found.push_back(at::empty({c, kGroups}, real));
  cuda::values_backward(from, by,
                        {found[0].mutable_data_ptr<float>(), found[1].mutable_data_ptr<float>(),
                         found[2].mutable_data_ptr<float>(), found[3].mutable_data_ptr<float>(),
                         steps_learn ? found[4].mutable_data_ptr<float>() : nullptr},
                        c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found;
}

std::vector<Tensor> sample_bits(const Tensor& x, const Tensor& mean, const Tensor& scale, const Tensor& steps,
                                const Tensor& counted, const Tensor& masks, double p_min, double smallest_scale) {
  TORCH_CHECK(x.dim() == 2 && masks.dim() == 2, "sw_anchors: x must be [s,numbers], masks [s,k]");
  const int64_t s = x.size(0), k = masks.size(1), numbers = x.size(1);
  TORCH_CHECK(numbers >= 6 + 3 * k, "sw_anchors: ", numbers, " numbers are too few for ", k, " offsets");
  check(x, "x", x, {s, numbers});
  check(mean, "mean", x, {s, numbers});
  check(scale, "scale", x, {s, numbers});
  check(steps, "steps", x, {s, kGroups});
  check(counted, "counted", x, {s});
  check(masks, "masks", x, {s, k});
  const c10::cuda::CUDAGuard guard(x.device());
  const auto real = x.options().requires_grad(false);
  std::vector<Tensor> found = {at::empty({s, kGroups}, real), at::empty({s, numbers}, real),
                               at::empty({s, numbers}, real), at::empty({s, numbers}, real),
                               at::empty({s, kGroups}, real), at::empty({s, k}, real)};
  const Sample sample{s, int(numbers - 6 - 3 * k), int(k), x.const_data_ptr<float>(), mean.const_data_ptr<float>(),
                      scale.const_data_ptr<float>(), steps.const_data_ptr<float>(), counted.const_data_ptr<float>(),
                      masks.const_data_ptr<float>(), float(p_min), float(smallest_scale)};
  cuda::sample_bits(sample,
                    {found[0].mutable_data_ptr<float>(), found[1].mutable_data_ptr<float>(),
                     found[2].mutable_data_ptr<float>(), found[3].mutable_data_ptr<float>(),
                     found[4].mutable_data_ptr<float>(), found[5].mutable_data_ptr<float>()},
                    c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found;
}

}  // namespace

TORCH_LIBRARY_IMPL(sw_anchors, CUDA, m) {
  m.impl("load_rows", load_rows);
  m.impl("take_rows", take_rows);
  m.impl("scatter_rows", scatter_rows);
  m.impl("add_rows", add_rows);
  m.impl("row_values", row_values);
  m.impl("row_values_backward", row_values_backward);
  m.impl("sample_bits", sample_bits);
}

#endif  // SW_WITH_CUDA
