// Nearest entries of a codebook: boxes about groups of entries leave out what cannot be the nearest one.
//
// Entries are cut by the median of their widest axis into leaves of 16, 8 successive leaves are a branch. A box bounds
// the first `kept` axes of what is in it. Each term of the distance to a box is at most that of the distance to an entry
// in it, and sums are made in one order: also after rounding no box is farther than its entries. So what is found is the
// least of the distances as float32 computes them, of equal ones the entry of the lowest number.
#include <algorithm>
#include <cstring>
#include <limits>
#include <numeric>
#include <vector>

#include "kernels.h"

namespace SW_ARCH {
namespace {

constexpr int kLanes = 8, kLeaf = 2 * kLanes, kBranch = kLanes;
constexpr int kAxes = 8;  // of a box: with the axes by falling variance more of them cost more than they leave out
constexpr int64_t kRowsSeen = 256;  // that one thread takes at a time
constexpr float kFar = std::numeric_limits<float>::infinity();

typedef float Vec __attribute__((vector_size(4 * kLanes)));
typedef int32_t Mask __attribute__((vector_size(4 * kLanes)));

inline Vec all(float x) { return Vec{x, x, x, x, x, x, x, x}; }
inline Vec load(const float* p) {
  Vec v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
inline Vec least(Vec a, Vec b) { return a < b ? a : b; }
inline Vec most(Vec a, Vec b) { return a > b ? a : b; }
#ifdef __clang__
#define SW_SHUFFLED(v, ...) __builtin_shufflevector(v, v, __VA_ARGS__)
#else
#define SW_SHUFFLED(v, ...) __builtin_shuffle(v, Mask{__VA_ARGS__})
#endif

inline float least(Vec v) {
  v = least(v, SW_SHUFFLED(v, 4, 5, 6, 7, 0, 1, 2, 3));
  v = least(v, SW_SHUFFLED(v, 2, 3, 0, 1, 6, 7, 4, 5));
  v = least(v, SW_SHUFFLED(v, 1, 0, 3, 2, 5, 4, 7, 6));
  return v[0];
}

// 8 boxes: the lowest and the highest corners, axis by axis.
struct Boxes {
  float low[kAxes][kLanes], high[kAxes][kLanes];
};

class Tree {
 public:
  Tree(const float* entries, int64_t size, int dim)
      : dim_(dim), kept_(std::min(dim, kAxes)), order_(size), entries_(entries) {
    std::iota(order_.begin(), order_.end(), 0);
    cut(0, size);
    leaves_ = (size + kLeaf - 1) / kLeaf;
    const int64_t branches = (leaves_ + kBranch - 1) / kBranch;
    leaf_boxes_.resize(branches);
    branch_boxes_.resize((branches + kLanes - 1) / kLanes);
    values_.assign(leaves_ * kLeaf * dim, kFar);
    for (int64_t leaf = 0; leaf < leaves_; ++leaf) {
      const int64_t end = std::min((leaf + 1) * kLeaf, size);
      for (int64_t i = leaf * kLeaf; i < end; ++i)
        for (int axis = 0; axis < dim; ++axis)
          values_[(leaf * dim + axis) * kLeaf + i % kLeaf] = entries[order_[i] * dim + axis];
      bound(leaf_boxes_[leaf / kBranch], int(leaf % kBranch), leaf * kLeaf, end);
    }
    for (int64_t leaf = leaves_; leaf < branches * kBranch; ++leaf)
      bound(leaf_boxes_[leaf / kBranch], int(leaf % kBranch), 0, 0);
    for (int64_t branch = 0; branch < int64_t(branch_boxes_.size()) * kLanes; ++branch)
      bound(branch_boxes_[branch / kLanes], int(branch % kLanes), std::min(branch * kBranch * kLeaf, size),
            std::min((branch + 1) * kBranch * kLeaf, size));
  }

  int64_t leaves() const { return leaves_; }

  // The nearest entry; `near` [branches, up to the next 8] is overwritten, `seen` grows by the leaves looked at.
  int64_t search(const float* row, float* near, int64_t& seen) const {
    Found found{kFar, 0, 0};
    float closest = kFar;
    int64_t first = 0;
    for (size_t i = 0; i < branch_boxes_.size(); ++i) {
      const Vec away = distance(branch_boxes_[i], row);
      std::memcpy(near + i * kLanes, &away, sizeof away);
      const float one = least(away);
      if (one < closest) closest = one, first = int64_t(i);
    }
    if (!(closest < kFar)) return 0;  // not a number, or far beyond float32
    first *= kLanes;
    while (near[first] != closest) ++first;
    look_at(first, row, found);
    near[first] = kFar;
    for (int64_t branch = 0; branch < int64_t(leaf_boxes_.size()); ++branch)
      if (near[branch] <= found.distance && near[branch] < kFar) look_at(branch, row, found);
    seen += found.seen;
    return found.entry;
  }

 private:
  struct Found {
    float distance;
    int64_t entry, seen;
  };

  void cut(int64_t begin, int64_t end) {
    if (end - begin <= kLeaf) return;
    int widest = 0;
    float extent = -1;
    for (int axis = 0; axis < kept_; ++axis) {
      float low = kFar, high = -kFar;
      for (int64_t i = begin; i < end; ++i) {
        const float x = entries_[order_[i] * dim_ + axis];
        low = std::min(low, x), high = std::max(high, x);
      }
      if (high - low > extent) extent = high - low, widest = axis;
    }
    // Leaves are full, but for the last one.
    const int64_t half = (end - begin + kLeaf - 1) / kLeaf / 2, middle = begin + half * kLeaf;
    std::nth_element(order_.begin() + begin, order_.begin() + middle, order_.begin() + end, [&](int64_t a, int64_t b) {
      return entries_[a * dim_ + widest] < entries_[b * dim_ + widest];
    });
    cut(begin, middle);
    cut(middle, end);
  }

  void bound(Boxes& boxes, int lane, int64_t begin, int64_t end) {
    for (int axis = 0; axis < kept_; ++axis) {
      float low = kFar, high = begin < end ? -kFar : kFar;
      for (int64_t i = begin; i < end; ++i) {
        const float x = entries_[order_[i] * dim_ + axis];
        low = std::min(low, x), high = std::max(high, x);
      }
      boxes.low[axis][lane] = low, boxes.high[axis][lane] = high;  // of nothing: infinitely far
    }
  }

  Vec distance(const Boxes& boxes, const float* row) const {
    Vec sum = all(0);
    for (int axis = 0; axis < kept_; ++axis) {
      const Vec x = all(row[axis]);
      const Vec gap = most(most(load(boxes.low[axis]) - x, x - load(boxes.high[axis])), all(0));
      sum += gap * gap;
    }
    return sum;
  }

  void look_at(int64_t branch, const float* row, Found& found) const {
    Vec away = distance(leaf_boxes_[branch], row);
    for (float closest = least(away); closest <= found.distance && closest < kFar; closest = least(away)) {
      int lane = 0;
      while (away[lane] != closest) ++lane;
      away[lane] = kFar;
      look_into(branch * kBranch + lane, row, found);
    }
  }

  void look_into(int64_t leaf, const float* row, Found& found) const {
    const float* values = values_.data() + leaf * dim_ * kLeaf;
    Vec a = all(0), b = all(0);
    for (int axis = 0; axis < kept_; ++axis) add(values, axis, row, a, b);
    ++found.seen;
    if (dim_ > kept_) {
      if (least(least(a, b)) > found.distance) return;
      for (int axis = kept_; axis < dim_; ++axis) add(values, axis, row, a, b);
    }
    if (!(least(least(a, b)) <= found.distance)) return;
    for (int i = 0; i < kLeaf; ++i) {
      const float d = i < kLanes ? a[i] : b[i - kLanes];
      if (!(d <= found.distance) || !(d < kFar)) continue;
      const int64_t entry = order_[leaf * kLeaf + i];
      if (d < found.distance || entry < found.entry) found.distance = d, found.entry = entry;
    }
  }

  static void add(const float* values, int axis, const float* row, Vec& a, Vec& b) {
    const Vec x = all(row[axis]), p = load(values + axis * kLeaf) - x, q = load(values + axis * kLeaf + kLanes) - x;
    a += p * p, b += q * q;
  }

  int dim_, kept_;
  int64_t leaves_ = 0;
  std::vector<int64_t> order_;
  const float* entries_;
  std::vector<Boxes> leaf_boxes_, branch_boxes_;  // of 8 leaves each, of 8 branches each
  std::vector<float> values_;                     // [leaves][axes][16]
};

}  // namespace

double nearest_entries(const float* rows, int64_t n, const float* entries, int64_t size, int dim, int64_t* index,
                       const splatwizard::Parallel& parallel) {
  const Tree tree(entries, size, dim);
  const int64_t room = (tree.leaves() + kBranch * kLanes - 1) / (kBranch * kLanes) * kLanes;
  std::vector<int64_t> seen((n + kRowsSeen - 1) / kRowsSeen);
  parallel(int64_t(seen.size()), 1, [&](int64_t begin, int64_t end) {
    std::vector<float> near(room);
    for (int64_t part = begin; part < end; ++part)
      for (int64_t i = part * kRowsSeen; i < std::min((part + 1) * kRowsSeen, n); ++i)
        index[i] = tree.search(rows + i * dim, near.data(), seen[part]);
  });
  const int64_t all_seen = std::accumulate(seen.begin(), seen.end(), int64_t(0));
  return n ? double(all_seen) / double(n * tree.leaves()) : 0.0;
}

}  // namespace SW_ARCH
