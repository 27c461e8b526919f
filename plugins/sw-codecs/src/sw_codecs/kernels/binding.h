// The arguments of the ops on grids, checked.
#pragma once

#include <ATen/core/Tensor.h>

#include "levels.h"

namespace sw_grid {

inline Levels levels_of(at::ArrayRef<double> scales, at::IntArrayRef lasts, at::IntArrayRef starts,
                        at::IntArrayRef dense, int64_t log2_size, int64_t axes, int64_t entries) {
  const size_t count = scales.size();
  TORCH_CHECK(lasts.size() == count && starts.size() == count && dense.size() == count, "sw_codecs: malformed levels");
  return levels_of(int64_t(count), scales.data(), lasts.data(), starts.data(), dense.data(), log2_size, axes, entries,
                   [](const std::string& text) { TORCH_CHECK(false, "sw_codecs: ", text); });
}

inline void check(const at::Tensor& t, const char* name, const at::Tensor& like, at::IntArrayRef shape) {
  TORCH_CHECK(t.scalar_type() == at::kFloat && t.is_contiguous() && t.device() == like.device() && t.sizes() == shape,
              "sw_codecs: ", name, " must be contiguous float32 ", shape, " on ", like.device(), ", got ",
              t.toString(), " ", t.sizes(), " on ", t.device());
}

// Places x [n, columns] in a grid of signs over some of the columns; `features` [n, row]: those of this grid start at
// column `first`. Checks that `table` [entries, features a vertex] and `features` hold all that is read and written.
inline Signs signs_of(const at::Tensor& x, at::IntArrayRef axes, const at::Tensor& table, const at::Tensor& features,
                      int64_t first, at::ArrayRef<double> scales, at::IntArrayRef lasts, at::IntArrayRef starts,
                      at::IntArrayRef dense, int64_t log2_size) {
  TORCH_CHECK(x.dim() == 2 && table.dim() == 2 && features.dim() == 2 && x.size(1) <= 3 && table.size(1) > 0 &&
                  table.size(1) <= kMaxFeatures,
              "sw_codecs: x must be [n,2 or 3], the table [entries,1 to ", kMaxFeatures, "]");
  Signs at{};
  at.levels = levels_of(scales, lasts, starts, dense, log2_size, int64_t(axes.size()), table.size(0));
  at.count = x.size(0), at.columns = int(x.size(1)), at.axes = int(axes.size());
  for (size_t i = 0; i < axes.size(); ++i) {
    TORCH_CHECK(axes[i] >= 0 && axes[i] < x.size(1), "sw_codecs: there is no axis ", axes[i]);
    at.axis[i] = int(axes[i]);
  }
  at.features = int(table.size(1)), at.row = features.size(1), at.x = x.const_data_ptr<float>();
  check(x, "x", x, {at.count, x.size(1)});
  check(table, "table", x, table.sizes());
  check(features, "features", x, {at.count, at.row});
  TORCH_CHECK(first >= 0 && first + int64_t(at.levels.count) * at.features <= at.row,
              "sw_codecs: features do not fit");
  return at;
}

}  // namespace sw_grid
