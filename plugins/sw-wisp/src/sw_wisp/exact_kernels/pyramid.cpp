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

// Means of a cell: values of base and of latents, then activities of both. Those of a walk through packets are whole and
// within +-2^20, as all that they are means of.
constexpr int64_t VIEW_VALUES = BASE, ACTIVITIES = BASE + VIEW, VIEW_ACTIVITIES = ACTIVITIES + BASE;

// M = floor((sum + 2 M of the parent) / (n + 2)); as the parent where nothing is known.
template <int64_t WIDTH, class T>
void shrink(const double* sums, double count, const T* above, T* found) {
  for (int64_t c = 0; c < WIDTH; ++c)
    found[c] = static_cast<T>(std::floor((sums[c] + PULL * static_cast<double>(above[c])) / count));
}

// Both halves of a part of the numbers, which begin at `first` and at `second`.
template <int64_t WIDTH, class T>
void shrink_part(const double* sums, int64_t first, int64_t second, const T* above, T* found) {
  if (sums == nullptr) {
    std::memcpy(found + first, above + first, sizeof(T) * WIDTH);
    std::memcpy(found + second, above + second, sizeof(T) * WIDTH);
    return;
  }
  const double count = sums[2 * WIDTH] + PULL;
  shrink<WIDTH>(sums, count, above + first, found + first);
  shrink<WIDTH>(sums + WIDTH, count, above + second, found + second);
}

// Means of the cells that are needed.
template <class T>
void shrink_cells(const pyramid_features_call& a, int64_t begin, int64_t end, T* means) {
  for (int64_t cell = begin; cell < end; ++cell) {
    if (!a.needed[cell]) continue;
    T* found = means + MEANS * cell;
    if (cell == 0) {
      for (int64_t c = 0; c < BASE; ++c)
        found[c] = static_cast<T>(a.base_prior[c]), found[ACTIVITIES + c] = static_cast<T>(a.base_prior[BASE + c]);
      for (int64_t c = 0; c < VIEW; ++c)
        found[VIEW_VALUES + c] = static_cast<T>(a.view_prior[c]),
        found[VIEW_ACTIVITIES + c] = static_cast<T>(a.view_prior[VIEW + c]);
      continue;
    }
    const T* above = means + MEANS * a.parent[cell];
    shrink_part<BASE>(a.base_sums ? a.base_sums + (2 * BASE + 1) * cell : nullptr, 0, ACTIVITIES, above, found);
    shrink_part<VIEW>(a.view_sums ? a.view_sums + (2 * VIEW + 1) * cell : nullptr, VIEW_VALUES, VIEW_ACTIVITIES, above,
                      found);
  }
}

template <class T>
void find_means(const pyramid_features_call& a, T* means, const Parallel& parallel) {
  std::memset(a.needed, 0, static_cast<size_t>(a.cells));
  for (int64_t i = 0; i < a.n; ++i)
    for (int64_t at = a.leaf[a.rows[i]]; !a.needed[at]; at = a.parent[at]) {
      a.needed[at] = true;
      if (at == 0) break;
    }
  for (int64_t level = 0; level <= DEEPEST; ++level)
    parallel(a.starts[level + 1] - a.starts[level], 256, [&](int64_t begin, int64_t end) {
      constexpr int64_t SOME = 1024;  // a call: WebAssembly takes better code for a function at its next call
      for (int64_t from = begin; from < end; from += SOME)
        shrink_cells(a, a.starts[level] + from, a.starts[level] + (from + SOME < end ? from + SOME : end), means);
    });
}

inline void take_means(const int32_t* means, int32_t* to) { std::memcpy(to, means, sizeof(int32_t) * ACTIVITIES); }
inline void take_means(const double* means, int64_t* to) {
  for (int64_t c = 0; c < ACTIVITIES; ++c)
    to[c] = static_cast<int64_t>(means[c] < -LIMIT ? -LIMIT : means[c] > LIMIT ? LIMIT : means[c]);
}

// What splat `row` sees of the means around it.
template <class Mean, class T>
void see(const pyramid_features_call& a, const Mean* means, int64_t row, T* to) {
  const int64_t level = a.levels[row], leaf = a.leaf[row];
  // The finest cell around the splat, of this level at most.
  const auto around = [&](int64_t most) {
    int64_t at = leaf;
    for (int64_t up = a.depth[leaf] - most; up > 0; --up) at = a.parent[at];
    return at;
  };
  const int64_t at[2] = {level < DEEPEST ? level : DEEPEST, level - 3};
  const int64_t cell[2] = {around(at[0]), around(at[1])};
  take_means(means + MEANS * cell[0], to);
  take_means(means + MEANS * cell[1], to + ACTIVITIES);
  take_means(means + MEANS * around(level - 1 < DEEPEST ? level - 1 : DEEPEST) + ACTIVITIES, to + 2 * ACTIVITIES);
  to += 3 * ACTIVITIES;
  *to++ = static_cast<T>(level) * static_cast<T>(SIXTEENTH);
  for (int k = 0; k < 2; ++k) {
    const bool is_shared = a.base_sums != nullptr && a.depth[cell[k]] >= at[k];
    const double count = is_shared ? a.base_sums[(2 * BASE + 1) * cell[k] + 2 * BASE] : 0;
    *to++ = static_cast<T>((count < MOST_COUNTED ? count : MOST_COUNTED) * SIXTEENTH);
  }
}

}  // namespace

void pyramid_means(const pyramid_features_call& a, int32_t* means) { find_means(a, means, Parallel()); }

void pyramid_seen(const pyramid_features_call& a, const int32_t* means, const int64_t* rows, int64_t n, int64_t stride,
                  int32_t* found) {
  for (int64_t i = 0; i < n; ++i) see(a, means, rows[i], found + stride * i);
}

void pyramid_features(const pyramid_features_call& a, const Parallel& parallel) {
  find_means(a, a.means, parallel);
  parallel(a.n, 256, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) see(a, a.means, a.rows[i], a.found + FEATURES * i);
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
