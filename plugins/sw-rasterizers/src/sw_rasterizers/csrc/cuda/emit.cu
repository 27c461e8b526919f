// Pairs: one (tile, splat) for every tile that a splat touches, written in depth order.
//
// A block takes 128 splats; where its pairs start is a prefix sum over the grid within the same launch. A splat of
// few rows is listed by its own thread; a large one by its whole warp, a row of tiles a lane or, where rows are long, a
// tile a lane. The block's pairs are put together in shared memory, unless they are too many, and written in one run.
#include "device.h"
#include "kernels.h"
#include "splat.h"

namespace sw::cuda {
namespace {

// Where a splat's pairs go. A tile beyond the count that was reserved is left out, and a reserved place that no
// tile claims gets the key `tiles`, which belongs to no tile: should rounding ever differ between the two passes.
template <class Key>
struct Target {
  Key* keys;
  int32_t* values;
  unsigned at, end;

  __device__ __forceinline__ void put(int tile, int value) {
    if (at < end) keys[at] = Key(tile), values[at] = value, ++at;
  }
  __device__ __forceinline__ void fill(int no_tile, int value, unsigned step) {
    for (; at < end; at += step) keys[at] = Key(no_tile), values[at] = value;
  }
};

constexpr unsigned kStaged = 2048;  // pairs of a block; 5 a splat are usual

template <class Key, bool kTight>
__global__ void __launch_bounds__(kEmitThreads)
    emit_kernel(View<float> view, int count, const int32_t* order, Splats splats, SplatWork work, bool copy,
                Splats compact, int channels, Key* keys, int32_t* values, Counters* counters, uint64_t* states) {
  __shared__ unsigned scratch[kWarp + 1];
  __shared__ unsigned block_number;
  __shared__ __align__(16) unsigned base;  // no neighbour's wide load may touch it while it is written
  __shared__ Key staged_keys[kStaged];
  __shared__ int32_t staged_values[kStaged];
  if (threadIdx.x == 0) block_number = atomicAdd(&counters->emit_ticket, 1u);
  __syncthreads();
  const int rank = int(block_number) * kEmitThreads + int(threadIdx.x);
  const bool used = rank < count;
  const int slot = used ? order[rank] : 0;
  const int tiles = used ? work.tiles[slot] : 0;
  float4 s0 = make_float4(0.f, 0.f, 0.f, 0.f), s1 = s0;
  TileBox box = {};
  Ellipse<float> ellipse = {};
  if (used) {
    s0 = splats.shape[2 * int64_t(slot)], s1 = splats.shape[2 * int64_t(slot) + 1];
    if constexpr (kTight) {
      ellipse = ellipse_of(s0.x, s0.y, s0.z, s0.w, s1.x, s1.y, work.extent[slot]);
      box = tile_box(ellipse, view.width, view.height);
    } else {
      box.tiles = classic_tiles(s0.x, s0.y, float(work.radius[slot]), view.tiles_x(), view.tiles_y());
    }
    if (copy) {
      compact.shape[2 * int64_t(rank)] = s0, compact.shape[2 * int64_t(rank) + 1] = s1;
      compact.tail[rank] = splats.tail[slot];
      for (int k = 0; k < channels; ++k)
        compact.channels[int64_t(rank) * channels + k] = splats.channels[int64_t(slot) * channels + k];
    }
  }
  unsigned block_tiles;
  const unsigned position = block_prefix(unsigned(tiles), scratch, &block_tiles);
  if (warp_index() == 0) {
    const unsigned before = look_back(states, int(block_number), block_tiles);
    if (lane_index() == 0) base = before;
  }
  __syncthreads();

  const int value = copy ? rank : slot;
  const int tiles_x = view.tiles_x(), no_tile = tiles_x * view.tiles_y();
  const bool staged = block_tiles <= kStaged;
  Key* const to_keys = staged ? staged_keys : keys + base;
  int32_t* const to_values = staged ? staged_values : values + base;
  Target<Key> own{to_keys, to_values, position, position + unsigned(tiles)};
  const int rows = tiles > 0 ? box.tiles.y1 - box.tiles.y0 : 0;
  const auto put_row = [&](Target<Key>& to, const TileBox& in, const Ellipse<float>& e, int row, int of) {
    int first = in.tiles.x0, last = in.tiles.x1;
    if constexpr (kTight) slab_span(e, in, 1.f / e.hy, row, &first, &last);
    for (int x = first; x < last; ++x) to.put(row * tiles_x + x, of);
  };
  if (rows <= kOwnRows) {
    if (box.tiles.count() == 1)  // most splats of a trained scene
      own.put(box.tiles.y0 * tiles_x + box.tiles.x0, value);
    else
      for (int row = box.tiles.y0; row < box.tiles.y1; ++row) put_row(own, box, ellipse, row, value);
    own.fill(no_tile, value, 1);
  }
  for (unsigned left = __ballot_sync(kAllLanes, rows > kOwnRows); left != 0; left &= left - 1) {
    const int owner = __ffs(int(left)) - 1;
    const auto from = [&](auto x) { return __shfl_sync(kAllLanes, x, owner); };
    const Ellipse<float> e = from_lane(ellipse, owner);
    TileBox in = {};
    if constexpr (kTight) in = tile_box(e, view.width, view.height);
    else in.tiles = {from(box.tiles.x0), from(box.tiles.x1), from(box.tiles.y0), from(box.tiles.y1)};
    const int of = from(value);
    Target<Key> to{to_keys, to_values, from(own.at), from(own.end)};
    for (int row0 = in.tiles.y0; row0 < in.tiles.y1; row0 += kWarp) {
      const int row = row0 + lane_index();
      int first = in.tiles.x0, last = in.tiles.x1;
      if constexpr (kTight) {
        if (row < in.tiles.y1) slab_span(e, in, 1.f / e.hy, row, &first, &last);
      }
      const unsigned width = row < in.tiles.y1 ? unsigned(last - first) : 0u;
      const unsigned at = to.at + warp_prefix(width);
      const int listed = min(kWarp, in.tiles.y1 - row0);
      if (int(warp_max(width)) > listed) {  // long rows: one after the other, so that lanes write side by side
        for (int i = 0; i < listed; ++i) {
          const unsigned long_width = __shfl_sync(kAllLanes, width, i), start = __shfl_sync(kAllLanes, at, i);
          const int left_tile = (row0 + i) * tiles_x + __shfl_sync(kAllLanes, first, i);
          for (unsigned x = unsigned(lane_index()); x < long_width; x += kWarp)
            Target<Key>{to_keys, to_values, start + x, to.end}.put(left_tile + int(x), of);
        }
      } else {
        Target<Key> mine{to_keys, to_values, at, to.end};
        for (unsigned x = 0; x < width; ++x) mine.put(row * tiles_x + first + int(x), of);
      }
      to.at += warp_sum(width);
    }
    to.at += unsigned(lane_index());
    to.fill(no_tile, of, kWarp);
  }
  if (!staged) return;
  __syncthreads();
  for (unsigned i = threadIdx.x; i < block_tiles; i += kEmitThreads)
    keys[base + i] = staged_keys[i], values[base + i] = staged_values[i];
}

// Where each tile's pairs start: a pair that differs from the one before it starts its tile, and all empty ones since.
template <class Key>
__global__ void find_tiles_kernel(int count, int tiles, const Key* keys, int32_t* start) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i > count) return;
  const int tile = i == count ? tiles : min(int(keys[i]), tiles);
  const int before = i == 0 ? -1 : min(int(keys[i - 1]), tiles);
  for (int t = before + 1; t <= tile; ++t) start[t] = int32_t(i);
}

}  // namespace

void emit(const View<float>& view, const Settings& settings, int count, const int32_t* order, const Splats& splats,
          const SplatWork& work, const Splats* compact, int channels, void* keys, bool wide, int32_t* values,
          Counters* counters, uint64_t* states, cudaStream_t stream) {
  const unsigned blocks = unsigned(ceil_div(count, kEmitThreads));
  const Splats target = compact != nullptr ? *compact : Splats{};
  const auto run = [&](auto kernel, auto* typed) {
    kernel<<<blocks, kEmitThreads, 0, stream>>>(view, count, order, splats, work, compact != nullptr, target, channels,
                                                typed, values, counters, states);
  };
  if (wide)
    run(settings.tight ? emit_kernel<uint32_t, true> : emit_kernel<uint32_t, false>, static_cast<uint32_t*>(keys));
  else
    run(settings.tight ? emit_kernel<uint16_t, true> : emit_kernel<uint16_t, false>, static_cast<uint16_t*>(keys));
}

void find_tiles(int count, int tiles, const void* keys, bool wide, int32_t* start, cudaStream_t stream) {
  constexpr int kThreads = 256;
  const unsigned blocks = unsigned(ceil_div(int64_t(count) + 1, kThreads));
  if (wide)
    find_tiles_kernel<<<blocks, kThreads, 0, stream>>>(count, tiles, static_cast<const uint32_t*>(keys), start);
  else
    find_tiles_kernel<<<blocks, kThreads, 0, stream>>>(count, tiles, static_cast<const uint16_t*>(keys), start);
}

}  // namespace sw::cuda
