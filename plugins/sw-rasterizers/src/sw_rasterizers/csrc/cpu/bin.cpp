// Binning: from slots to one front-to-back list of splats per tile.
//
// Splats are sorted by depth once (V keys, not P), then dealt to the tiles by a counting sort that keeps the order:
// threads own contiguous depth ranges and every tile's list is the ranges' parts one after the other. So a list is
// ordered by (depth, index) by construction and does not depend on the number of threads.
#include <algorithm>
#include <cstring>
#include <memory>
#include <vector>

#include "kernels.h"
#include "parallel.h"

namespace SW_ARCH {
namespace {

// Stable LSD radix sort of positive floats by their bit patterns, 11 bits a pass.
struct RadixSorter {
  static constexpr int kBits = 11, kBuckets = 1 << kBits, kPasses = 3;
  int64_t count;
  const splatwizard::Parallel* threads;
  std::unique_ptr<uint32_t[]> keys[2];
  std::unique_ptr<int32_t[]> values;

  RadixSorter(int64_t count, const splatwizard::Parallel* threads) : count(count), threads(threads) {
    for (auto& k : keys) k.reset(new uint32_t[count]);
    values.reset(new int32_t[count]);
  }

  // keys[0] and `order` hold the input; afterwards `order` is sorted.
  void sort(int32_t* order) {
    int32_t* from_values = order;
    int32_t* to_values = values.get();
    for (int pass = 0; pass < kPasses; ++pass) {
      run_pass(pass * kBits, keys[pass & 1].get(), keys[(pass & 1) ^ 1].get(), from_values, to_values);
      std::swap(from_values, to_values);
    }
    if (from_values != order) std::memcpy(order, from_values, size_t(count) * sizeof *order);
  }

  void run_pass(int shift, const uint32_t* keys_in, uint32_t* keys_out, const int32_t* in, int32_t* out) {
    const int parts = count_of(threads);
    std::vector<int64_t> cursor(size_t(parts) * kBuckets, 0);
    parallel_dynamic(threads, parts, [&](int64_t part) {
      int64_t* histogram = cursor.data() + part * kBuckets;
      for (int64_t i = count * part / parts; i < count * (part + 1) / parts; ++i)
        ++histogram[(keys_in[i] >> shift) & (kBuckets - 1)];
    });
    int64_t sum = 0;
    for (int b = 0; b < kBuckets; ++b)
      for (int part = 0; part < parts; ++part) {
        int64_t& c = cursor[size_t(part) * kBuckets + b];
        const int64_t n = c;
        c = sum;
        sum += n;
      }
    parallel_dynamic(threads, parts, [&](int64_t part) {
      int64_t* position = cursor.data() + part * kBuckets;
      for (int64_t i = count * part / parts; i < count * (part + 1) / parts; ++i) {
        const int64_t to = position[(keys_in[i] >> shift) & (kBuckets - 1)]++;
        keys_out[to] = keys_in[i];
        out[to] = in[i];
      }
    });
  }
};

int64_t chunks_of(int64_t count) { return (count + kChunk - 1) / kChunk; }

// Slots in use, in order; fill_key(i, slot) sees each of them.
template <class S, class FillKey>
void list_slots(int64_t count, const Slots<S>& slots, const splatwizard::Parallel* threads, int32_t* order,
                const FillKey& fill_key) {
  std::vector<int64_t> start(size_t(chunks_of(count)) + 1, 0);
  for (int64_t chunk = 0; chunk < chunks_of(count); ++chunk)
    start[size_t(chunk) + 1] = start[size_t(chunk)] + slots.per_chunk[chunk];
  parallel_dynamic(threads, chunks_of(count), [&](int64_t chunk) {
    int64_t i = start[size_t(chunk)];
    for (int64_t s = chunk * kChunk; i < start[size_t(chunk) + 1]; ++s, ++i) {
      order[i] = int32_t(s);
      fill_key(i, s);
    }
  });
}

}  // namespace

template <class S>
int64_t count_pairs(int64_t count, const Slots<S>& slots) {
  int64_t pairs = 0;
  for (int64_t chunk = 0; chunk < chunks_of(count); ++chunk)
    for (int64_t s = chunk * kChunk, end = s + slots.per_chunk[chunk]; s < end; ++s) pairs += slots.run[s].count;
  return pairs;
}

template <>
void depth_order<float>(int64_t count, int64_t used, const Slots<float>& slots, const splatwizard::Parallel* threads,
                        int32_t* order) {
  RadixSorter sorter(used, threads);
  list_slots(count, slots, threads, order, [&](int64_t i, int64_t s) {
    std::memcpy(&sorter.keys[0][i], &slots.records[s * kRecord + kDepth], sizeof(float));
  });
  sorter.sort(order);
}

template <>
void depth_order<double>(int64_t count, int64_t used, const Slots<double>& slots, const splatwizard::Parallel* threads,
                         int32_t* order) {
  list_slots(count, slots, threads, order, [](int64_t, int64_t) {});
  std::stable_sort(order, order + used, [&](int32_t a, int32_t b) {
    return slots.records[int64_t(a) * kRecord + kDepth] < slots.records[int64_t(b) * kRecord + kDepth];
  });
}

template <class S>
void bin_pairs(const View<S>& view, const Settings& settings, int64_t count, int64_t used, const Slots<S>& slots,
               const int32_t* order, const Pairs<S>& pairs) {
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const int parts = count_of(settings.parallel);
  constexpr int64_t kAhead = 12;

  // Splat-major: the tile of every pair, chunk after chunk. A splat that was dropped leaves its tiles out.
  std::unique_ptr<int32_t[]> tile_of(new int32_t[pairs.count]);
  std::vector<int64_t> start(size_t(chunks_of(count)) + 1, 0);
  const auto for_chunk = [&](int64_t chunk, const auto& visit) {
    for (int64_t s = chunk * kChunk, end = s + slots.per_chunk[chunk]; s < end; ++s) visit(slots.run[s]);
  };
  parallel_dynamic(settings.parallel, chunks_of(count), [&](int64_t chunk) {
    for_chunk(chunk, [&](const PairRun& run) { start[size_t(chunk) + 1] += run.count; });
  });
  for (size_t chunk = 1; chunk < start.size(); ++chunk) start[chunk] += start[chunk - 1];
  parallel_dynamic(settings.parallel, chunks_of(count), [&](int64_t chunk) {
    int64_t next = start[size_t(chunk)];
    for_chunk(chunk, [&](PairRun& run) {
      const int32_t* from = slots.tiles + slots.tile_at[chunk] + run.first;
      run.first = int32_t(next);
      for (int32_t k = 0; k < run.count; ++k) tile_of[size_t(next++)] = from[k];
    });
  });

  std::vector<int64_t> cursor(size_t(parts) * tiles, 0);
  const auto for_range = [&](int64_t part, const auto& visit) {
    const int64_t stop = used * (part + 1) / parts;
    for (int64_t i = used * part / parts; i < stop; ++i) {
      // Depth order is random order in memory: ask for the run, then for its tiles, some splats ahead.
      if (i + 2 * kAhead < stop) __builtin_prefetch(slots.run + order[i + 2 * kAhead]);
      if (i + kAhead < stop) __builtin_prefetch(tile_of.get() + slots.run[order[i + kAhead]].first);
      const PairRun run = slots.run[order[i]];
      for (int32_t p = run.first; p < run.first + run.count; ++p) visit(order[i], p, tile_of[p]);
    }
  };
  parallel_dynamic(settings.parallel, parts, [&](int64_t part) {
    int64_t* histogram = cursor.data() + part * tiles;
    for_range(part, [&](int32_t, int32_t, int32_t tile) { ++histogram[tile]; });
  });
  int64_t sum = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    pairs.tile_start[tile] = sum;
    for (int part = 0; part < parts; ++part) {
      int64_t& c = cursor[size_t(part) * tiles + tile];
      const int64_t n = c;
      c = sum;
      sum += n;
    }
  }
  pairs.tile_start[tiles] = sum;
  parallel_dynamic(settings.parallel, parts, [&](int64_t part) {
    int64_t* position = cursor.data() + part * tiles;
    for_range(part, [&](int32_t s, int32_t pair, int32_t tile) {
      const int64_t to = position[tile]++;
      pairs.slot[to] = s;
      if (pairs.origin != nullptr) pairs.origin[to] = pair;
    });
  });
}

template int64_t count_pairs(int64_t, const Slots<float>&);
template int64_t count_pairs(int64_t, const Slots<double>&);
template void bin_pairs(const View<float>&, const Settings&, int64_t, int64_t, const Slots<float>&, const int32_t*,
                        const Pairs<float>&);
template void bin_pairs(const View<double>&, const Settings&, int64_t, int64_t, const Slots<double>&, const int32_t*,
                        const Pairs<double>&);

}  // namespace SW_ARCH
