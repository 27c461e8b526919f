// What the CUDA bindings share: events, and the memory and the launches that every forward pass has.
#pragma once

#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>

#include <algorithm>
#include <bit>
#include <limits>
#include <utility>
#include <vector>

#include "binding.h"
#include "cuda/kernels.h"

namespace sw::cuda {

class Event {
 public:
  explicit Event(bool timed) {
    C10_CUDA_CHECK(cudaEventCreateWithFlags(&event_, timed ? cudaEventDefault : cudaEventDisableTiming));
  }
  ~Event() {
    if (event_ != nullptr) C10_CUDA_CHECK_WARN(cudaEventDestroy(event_));
  }
  Event(Event&& other) noexcept : event_(std::exchange(other.event_, nullptr)) {}
  Event& operator=(Event&&) = delete;

  void record(cudaStream_t stream) { C10_CUDA_CHECK(cudaEventRecord(event_, stream)); }
  void wait() const { C10_CUDA_CHECK(cudaEventSynchronize(event_)); }
  double seconds_to(const Event& later) const {
    float milliseconds = 0;
    C10_CUDA_CHECK(cudaEventElapsedTime(&milliseconds, event_, later.event_));
    return 1e-3 * milliseconds;
  }

 private:
  cudaEvent_t event_ = nullptr;
};

// Seconds between marks, measured on the device; only where they are asked for, since reading them waits.
struct StageClock {
  bool on;
  cudaStream_t stream;
  std::vector<Event> events;
  void mark() {
    if (!on) return;
    events.emplace_back(true);
    events.back().record(stream);
  }
  std::vector<double> seconds() {
    std::vector<double> out;
    if (on) events.back().wait();
    for (size_t i = 1; i < events.size(); ++i) out.push_back(events[i - 1].seconds_to(events[i]));
    return out;
  }
};

inline void check_placement(const Inputs& in) {
  TORCH_CHECK(in.means.scalar_type() == at::kFloat, "sw_rasterizers: on CUDA means must be float32, got ",
              in.means.scalar_type());
  TORCH_CHECK(!in.background.has_value() || in.background->device() == in.means.device(),
              "sw_rasterizers: background is on ", in.background->device(), ", means on ", in.means.device());
  TORCH_CHECK(!in.quats.has_value() || reinterpret_cast<uintptr_t>(in.quats->data_ptr()) % 16 == 0,
              "sw_rasterizers: on CUDA quats must start at a multiple of 16 bytes; clone() it");
}

inline Splats splats_of(const Tensor& shape, const Tensor& tail, const Tensor& channels) {
  return {data<float4>(shape), data<float2>(tail), data<float>(channels)};
}

inline Tensor cuda_bytes(size_t count, const at::TensorOptions& options) {
  return at::empty({int64_t(std::max<size_t>(count, 1))}, options.dtype(at::kByte));
}

// The counters on the device, and what the host learns of them.
struct Tally {
  cudaStream_t stream;
  int64_t blocks;  // of the projection
  Tensor memory, pinned;
  Counters* counters;
  uint64_t* states;  // of the projection's prefix sums, then of the emission's
  Published* published;
  Counters* after;  // the colours
  Event counted{false}, colored{false};
  bool used = false;

  Tally(int64_t gaussians, const at::TensorOptions& options, cudaStream_t stream)
      : stream(stream), blocks(ceil_blocks(gaussians)) {
    const size_t bytes = sizeof(Counters) + 2 * size_t(blocks + 1) * sizeof(uint64_t);
    memory = cuda_bytes(bytes, options);
    counters = reinterpret_cast<Counters*>(memory.data_ptr());
    states = reinterpret_cast<uint64_t*>(counters + 1);
    C10_CUDA_CHECK(cudaMemsetAsync(counters, 0, bytes, stream));
    static_assert(sizeof(Published) + sizeof(Counters) <= 16 * sizeof(int64_t));
    pinned = at::empty({16}, at::TensorOptions().dtype(at::kLong).pinned_memory(true));
    published = reinterpret_cast<Published*>(pinned.data_ptr());
    after = reinterpret_cast<Counters*>(published + 1);
    *published = {};
    *after = {};
  }

  void projected() { counted.record(stream); }
  // The colours are launched: waits for the counts of the projection, while they are still being computed.
  void shaded() {
    C10_CUDA_CHECK(cudaMemcpyAsync(after, counters, sizeof(Counters), cudaMemcpyDeviceToHost, stream));
    colored.record(stream);
    C10_CUDA_KERNEL_LAUNCH_CHECK();
    counted.wait();
    used = true;
    TORCH_CHECK(pairs() <= std::numeric_limits<int32_t>::max(), "sw_rasterizers: ", pairs(),
                " splat-tile pairs are more than 2^31 - 1; render fewer Gaussians or a smaller image");
  }
  int64_t splats() const { return published->splats; }
  int64_t pairs() const { return published->pairs; }

  // Visible, pairs, evaluated, blended, not finite; at the end. `work`: whether work was counted.
  std::vector<int64_t> counts(bool work) const {
    if (used) colored.wait();  // long past by now
    int64_t evaluated = -1, blended = -1;
    if (work) {
      Counters now{};
      C10_CUDA_CHECK(cudaMemcpyAsync(&now, counters, sizeof now, cudaMemcpyDeviceToHost, stream));
      C10_CUDA_CHECK(cudaStreamSynchronize(stream));
      evaluated = int64_t(now.evaluated), blended = int64_t(now.blended);
    }
    const int64_t bad = after->bad_colors;
    return {published->visible - bad, pairs(), evaluated, blended, published->invalid + bad};
  }

 private:
  static int64_t ceil_blocks(int64_t gaussians) { return (gaussians + kProjectThreads - 1) / kProjectThreads; }
};

// What the projection writes: compact, but for up to N splats, since how many there are is not known yet.
struct Projected {
  Tensor shape, tail, channels, depth, order, extent, tiles, radius;
  Splats splats;
  SplatWork work;
  // `row`: channels of a splat.
  Projected(int64_t gaussians, int row, bool tight, const at::TensorOptions& real) {
    const auto make_int = [&](int64_t count) { return at::empty({count}, real.dtype(at::kInt)); };
    shape = at::empty({gaussians, 8}, real), tail = at::empty({gaussians, 2}, real);
    channels = at::empty({row > 0 ? gaussians : 0, row}, real);
    depth = make_int(gaussians), order = make_int(gaussians), extent = at::empty({gaussians, 2}, real);
    tiles = make_int(gaussians), radius = make_int(tight ? 0 : gaussians);
    splats = splats_of(shape, tail, channels);
    work = {data<uint32_t>(depth), data<float2>(extent), data<int32_t>(radius), data<int32_t>(tiles),
            data<int32_t>(order)};
  }
};

// The pairs by tile, nearest first; with `keep` also the splats in depth order, which the values then count.
struct Binned {
  struct {
    Tensor shape, tail, channels;
  } compact;
  Tensor tile_start, splat;
  Tensor depth_other;
  Splats drawn;
  const uint32_t* sorted_depth = nullptr;  // of the splats in depth order; lives as long as this and Projected

  TileLists lists() const { return {data<int32_t>(tile_start), data<int32_t>(splat)}; }

  // Marks the clock between sorting and binning.
  Binned(const View<float>& view, const Settings& settings, const Projected& projected, const Tally& tally, int row,
         bool keep, StageClock& clock)
      : drawn(projected.splats) {
    const cudaStream_t stream = tally.stream;
    const int64_t used = tally.splats(), count = tally.pairs();
    const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
    const bool wide = tiles >= 0xffff;  // one key more than tiles: for places that no tile claims
    const auto real = projected.shape.options();
    const auto make = [&](at::IntArrayRef shape) { return at::empty(shape, real); };
    const auto make_as = [&](at::IntArrayRef shape, at::ScalarType type) { return at::empty(shape, real.dtype(type)); };

    int32_t* sorted = nullptr;
    Tensor order_other;
    if (used > 0) {
      depth_other = make_as({used}, at::kInt), order_other = make_as({used}, at::kInt);
      uint32_t* depth = nullptr;
      const auto run = [&](void* scratch, size_t size) {
        return depth_order(scratch, size, int(used), projected.work.depth, data<uint32_t>(depth_other),
                           projected.work.order, data<int32_t>(order_other), &sorted, &depth, stream);
      };
      const size_t size = run(nullptr, 0);
      run(cuda_bytes(size, real).data_ptr(), size);
      sorted_depth = depth;
    }
    clock.mark();

    tile_start = make_as({tiles + 1}, at::kInt);
    Tensor keys[2], values[2];
    void* sorted_keys = nullptr;
    int32_t* sorted_values = nullptr;
    if (count > 0) {
      for (Tensor& t : keys) t = make_as({count}, wide ? at::kInt : at::kShort);
      for (Tensor& t : values) t = make_as({count}, at::kInt);
      if (keep) {
        compact.shape = make({used, 8}), compact.tail = make({used, 2});
        compact.channels = make({row > 0 ? used : 0, row});
        drawn = splats_of(compact.shape, compact.tail, compact.channels);
      }
      emit(view, settings, int(used), sorted, projected.splats, projected.work, keep ? &drawn : nullptr, row,
           keys[0].data_ptr(), wide, data<int32_t>(values[0]), tally.counters, tally.states + tally.blocks + 1, stream);
      const int key_bits = std::bit_width(uint64_t(tiles));
      const auto run = [&](void* scratch, size_t size) {
        return sort_pairs(scratch, size, int(count), key_bits, wide, keys[0].data_ptr(), keys[1].data_ptr(),
                          data<int32_t>(values[0]), data<int32_t>(values[1]), &sorted_keys, &sorted_values, stream);
      };
      const size_t size = run(nullptr, 0);
      run(cuda_bytes(size, real).data_ptr(), size);
    }
    find_tiles(int(count), int(tiles), sorted_keys, wide, data<int32_t>(tile_start), stream);
    if (count > 0) splat = sorted_values == data<int32_t>(values[0]) ? values[0] : values[1];
  }
};

}  // namespace sw::cuda
