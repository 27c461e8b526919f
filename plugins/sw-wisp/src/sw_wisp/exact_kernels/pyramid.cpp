// Sums over cells of an octree, their shrunk means, and what a splat sees of them (sw_wisp.pyramid).
#include <cmath>
#include <cstring>

#include "kernels.h"

namespace SW_ARCH {

using splatwizard::Parallel;

namespace {

constexpr int64_t DEEPEST = 15, BASE = 10, VIEW = 12, MEANS = 2 * (BASE + VIEW), FEATURES = 69;
constexpr int64_t MOST_ACTIVE = 15;
constexpr double PULL = 2, LIMIT = 1 << 20, SIXTEENTH = 256, MOST_COUNTED = 15;

// M = floor((sum + 2 M of the parent) / (n + 2)); as the parent where nothing is known.
template <int64_t WIDTH>
void shrink(const double* sums, const double* above, double* found) {
  if (sums == nullptr) {
    std::memcpy(found, above, sizeof(double) * WIDTH);
    return;
  }
  const double count = sums[WIDTH] + PULL;
  for (int64_t c = 0; c < WIDTH; ++c) found[c] = std::floor((sums[c] + PULL * above[c]) / count);
}

// Means of the cells that are needed.
void shrink_cells(const pyramid_features_call& a, int64_t begin, int64_t end) {
  for (int64_t cell = begin; cell < end; ++cell) {
    if (!a.needed[cell]) continue;
    double* found = a.means + MEANS * cell;
    if (cell == 0) {
      std::memcpy(found, a.base_prior, sizeof(double) * 2 * BASE);
      std::memcpy(found + 2 * BASE, a.view_prior, sizeof(double) * 2 * VIEW);
      continue;
    }
    const double* above = a.means + MEANS * a.parent[cell];
    shrink<2 * BASE>(a.base_sums ? a.base_sums + (2 * BASE + 1) * cell : nullptr, above, found);
    shrink<2 * VIEW>(a.view_sums ? a.view_sums + (2 * VIEW + 1) * cell : nullptr, above + 2 * BASE, found + 2 * BASE);
  }
}

template <class T>
T bounded(double x) {
  return static_cast<T>(x < -LIMIT ? -LIMIT : x > LIMIT ? LIMIT : x);
}

// What splat `row` sees of the means around it.
template <class T>
void see(const pyramid_features_call& a, int64_t row, T* to) {
  const int64_t level = a.levels[row], leaf = a.leaf[row];
  // The finest cell around the splat, of this level at most.
  const auto around = [&](int64_t most) {
    int64_t at = leaf;
    for (int64_t up = a.depth[leaf] - most; up > 0; --up) at = a.parent[at];
    return at;
  };
  const auto put = [&](int64_t cell, int64_t activities) {
    const double *base = a.means + MEANS * cell + activities * BASE,
                 *view = a.means + MEANS * cell + 2 * BASE + activities * VIEW;
    for (int64_t c = 0; c < BASE; ++c) to[c] = bounded<T>(base[c]);
    for (int64_t c = 0; c < VIEW; ++c) to[BASE + c] = bounded<T>(view[c]);
    to += BASE + VIEW;
  };
  const int64_t at[2] = {level < DEEPEST ? level : DEEPEST, level - 3};
  const int64_t cell[2] = {around(at[0]), around(at[1])};
  for (int64_t each : cell) put(each, 0);
  put(around(level - 1 < DEEPEST ? level - 1 : DEEPEST), 1);
  *to++ = static_cast<T>(level) * static_cast<T>(SIXTEENTH);
  for (int k = 0; k < 2; ++k) {
    const bool is_shared = a.base_sums != nullptr && a.depth[cell[k]] >= at[k];
    const double count = is_shared ? a.base_sums[(2 * BASE + 1) * cell[k] + 2 * BASE] : 0;
    *to++ = static_cast<T>((count < MOST_COUNTED ? count : MOST_COUNTED) * SIXTEENTH);
  }
}

}  // namespace

void pyramid_means(const pyramid_features_call& a, const Parallel& parallel) {
  std::memset(a.needed, 0, static_cast<size_t>(a.cells));
  for (int64_t i = 0; i < a.n; ++i)
    for (int64_t at = a.leaf[a.rows[i]]; !a.needed[at]; at = a.parent[at]) {
      a.needed[at] = true;
      if (at == 0) break;
    }
  for (int64_t level = 0; level <= DEEPEST; ++level)
    parallel(a.starts[level + 1] - a.starts[level], 256, [&](int64_t begin, int64_t end) {
      shrink_cells(a, a.starts[level] + begin, a.starts[level] + end);
    });
}

void pyramid_seen(const pyramid_features_call& a, const int64_t* rows, int64_t n, int64_t stride, int32_t* found) {
  for (int64_t i = 0; i < n; ++i) see(a, rows[i], found + stride * i);
}

void pyramid_features(const pyramid_features_call& a, const Parallel& parallel) {
  pyramid_means(a, parallel);
  parallel(a.n, 256, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) see(a, a.rows[i], a.found + FEATURES * i);
  });
}

void pyramid_add(const pyramid_add_call& a, const Parallel& parallel) {
  const int64_t columns = a.columns, added = a.indices != nullptr ? 2 * columns + 1 : columns;
  parallel(added, 4, [&](int64_t begin, int64_t end) {  // no two threads have a column in common
    for (int64_t i = 0; i < a.n; ++i) {
      double from[32];
      for (int64_t c = 0; c < columns; ++c) from[c] = static_cast<double>(a.values[columns * i + c]);
      if (a.indices != nullptr) {
        for (int64_t c = 0; c < columns; ++c) {
          const int64_t k = a.indices[columns * i + c], size = k < 0 ? -k : k;
          from[c] = from[c] < -LIMIT ? -LIMIT : from[c] > LIMIT ? LIMIT : from[c];
          from[columns + c] = static_cast<double>(size < MOST_ACTIVE ? size : MOST_ACTIVE) * SIXTEENTH;
        }
        from[2 * columns] = 1;
      }
      const int64_t row = a.rows[i];
      float* own = a.own + a.width * row + a.first;
      for (int64_t c = begin; c < end; ++c) own[c] += static_cast<float>(from[c]);
      for (int64_t at = a.leaf[row];; at = a.parent[at]) {
        double* to = a.sums + a.width * at + a.first;
        for (int64_t c = begin; c < end; ++c) to[c] += from[c];
        if (at == 0) break;
      }
    }
  });
}

}  // namespace SW_ARCH
