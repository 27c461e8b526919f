// What the CUDA bindings share: events, and the memory and the launches that every forward pass has.
#pragma once

#include <ATen/core/Tensor.h>
#include <ATen/core/ivalue.h>
#include <ATen/ops/empty.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>

#include <algorithm>
#include <array>
#include <bit>
#include <limits>
#include <tuple>
#include <utility>
#include <vector>

#include "binding.h"
#include "kernels.h"

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
  TORCH_CHECK(!in.background.has_value() || in.background->is_contiguous(),
              "sw_rasterizers: background must be contiguous");
  TORCH_CHECK(!in.quats.has_value() || reinterpret_cast<uintptr_t>(in.quats->data_ptr()) % 16 == 0,
              "sw_rasterizers: on CUDA quats must start at a multiple of 16 bytes; clone() it");
}

// `shape`: [splats, 10], all their shapes and then all their tails.
inline Splats splats_of(const Tensor& shape, const Tensor& channels) {
  auto* first = data<float4>(shape);
  auto* tail = first == nullptr ? nullptr : reinterpret_cast<float2*>(first + 2 * shape.size(0));
  return {first, tail, data<float>(channels)};
}

inline Tensor cuda_bytes(size_t count, const at::TensorOptions& options) {
  return at::empty({int64_t(std::max<size_t>(count, 1))}, options.dtype(at::kByte));
}

// Places in one allocation: each of its own would cost the host about as much as a launch.
struct Layout {
  size_t bytes = 0;
  size_t add(size_t count, size_t size) {
    const size_t at = bytes;
    bytes += (count * size + 127) / 128 * 128;
    return at;
  }
};
template <class T>
T* place(const Tensor& memory, size_t at) {
  return reinterpret_cast<T*>(static_cast<char*>(memory.data_ptr()) + at);
}

// Where the device leaves its counts for the host, and the events that say so. A thread draws one view at a time and
// reads before it returns, so it needs one of them for each GPU; never freed, since a thread may outlive the driver.
struct Mailbox {
  Tensor pinned = at::empty({16}, at::TensorOptions().dtype(at::kLong).pinned_memory(true));
  Event counted{false}, colored{false};

  static Mailbox& of(int device) {
    static thread_local std::vector<Mailbox*> boxes;
    if (boxes.size() <= size_t(device)) boxes.resize(size_t(device) + 1);
    if (boxes[size_t(device)] == nullptr) boxes[size_t(device)] = new Mailbox;
    return *boxes[size_t(device)];
  }
};

// The counters on the device, and what the host learns of them.
struct Tally {
  cudaStream_t stream;
  int64_t blocks;  // of the projection
  Tensor memory;
  Mailbox& mailbox;
  Counters* counters;
  uint64_t* states;  // of the projection's prefix sums, then of the emission's
  Published* published;
  bool used = false, under_way = true;  // under_way: the device may still write into the mailbox

  Tally(int64_t gaussians, const at::TensorOptions& options, cudaStream_t stream)
      : stream(stream), blocks(ceil_blocks(gaussians)), mailbox(Mailbox::of(options.device().index())) {
    const size_t bytes = sizeof(Counters) + 2 * size_t(blocks + 1) * sizeof(uint64_t);
    memory = cuda_bytes(bytes, options);
    counters = reinterpret_cast<Counters*>(memory.data_ptr());
    states = reinterpret_cast<uint64_t*>(counters + 1);
    C10_CUDA_CHECK(cudaMemsetAsync(counters, 0, bytes, stream));
    static_assert(sizeof(Published) <= 16 * sizeof(int64_t));
    published = reinterpret_cast<Published*>(mailbox.pinned.data_ptr());
    *published = {};
  }
  // Where an error ends the call early: the next one, maybe on another stream, finds the mailbox at rest.
  ~Tally() {
    if (under_way) C10_CUDA_CHECK_WARN(cudaStreamSynchronize(stream));
  }
  Tally(const Tally&) = delete;
  Tally& operator=(const Tally&) = delete;

  void projected() { mailbox.counted.record(stream); }
  // The colours are launched: waits for the counts of the projection, while they are still being computed.
  void shaded(const Settings& settings) {
    mailbox.colored.record(stream);
    C10_CUDA_KERNEL_LAUNCH_CHECK();
    mailbox.counted.wait();
    used = true;
    // Positions are 32-bit numbers, and the kernels look up to three stages of 256 ahead of the last one.
    constexpr int64_t numbered = std::numeric_limits<int32_t>::max() - 1024;
    check_pairs(pairs(), std::min(settings.most_pairs, numbered), "12 to 20 bytes each");
  }
  int64_t splats() const { return published->splats; }
  int64_t pairs() const { return published->pairs; }

  // Visible, pairs, evaluated, blended, not finite; at the end. `work`: whether work was counted.
  std::vector<int64_t> counts(bool work) {
    if (used) mailbox.colored.wait();  // long past by now
    under_way = false;
    int64_t evaluated = -1, blended = -1;
    if (work) {
      Counters now{};
      C10_CUDA_CHECK(cudaMemcpyAsync(&now, counters, sizeof now, cudaMemcpyDeviceToHost, stream));
      C10_CUDA_CHECK(cudaStreamSynchronize(stream));
      evaluated = int64_t(now.evaluated), blended = int64_t(now.blended);
    }
    const auto bad = int64_t(published->bad_colors);
    return {published->visible - bad, pairs(), evaluated, blended, published->invalid + bad};
  }

 private:
  static int64_t ceil_blocks(int64_t gaussians) { return (gaussians + kProjectThreads - 1) / kProjectThreads; }
};

// What the projection writes: compact, but for up to N splats, since how many there are is not known yet.
struct Projected {
  Tensor memory;
  Splats splats;
  SplatWork work;
  // `row`: channels of a splat.
  Projected(int64_t gaussians, int row, bool tight, const at::TensorOptions& real) {
    const auto n = size_t(gaussians);
    Layout layout;
    const size_t shape = layout.add(n, 2 * sizeof(float4)), tail = layout.add(n, sizeof(float2));
    const size_t channels = layout.add(n, size_t(row) * sizeof(float)), extent = layout.add(n, sizeof(float2));
    const size_t depth = layout.add(n, 4), order = layout.add(n, 4), tiles = layout.add(n, 4);
    const size_t radius = layout.add(tight ? 0 : n, 4);
    memory = cuda_bytes(layout.bytes, real);
    splats = {place<float4>(memory, shape), place<float2>(memory, tail),
              row > 0 ? place<float>(memory, channels) : nullptr};
    work = {place<uint32_t>(memory, depth), place<float2>(memory, extent),
            tight ? nullptr : place<int32_t>(memory, radius), place<int32_t>(memory, tiles),
            place<int32_t>(memory, order)};
  }
};

// The pairs by tile, nearest first; with `keep` also the splats in depth order, which the values then count.
struct Binned {
  struct {
    Tensor shape, channels;
  } compact;
  Tensor tile_start, splat;
  Tensor depth_memory;
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
    const auto real = projected.memory.options().dtype(at::kFloat);
    const auto make = [&](at::IntArrayRef shape) { return at::empty(shape, real); };
    const auto make_as = [&](at::IntArrayRef shape, at::ScalarType type) { return at::empty(shape, real.dtype(type)); };

    int32_t* sorted = nullptr;
    if (used > 0) {
      const size_t scratch = depth_order_scratch(int(used));
      Layout layout;
      const size_t depth_at = layout.add(size_t(used), 4), order_at = layout.add(size_t(used), 4);
      const size_t scratch_at = layout.add(scratch, 1);
      depth_memory = cuda_bytes(layout.bytes, real);
      uint32_t* depth = nullptr;
      depth_order(place<char>(depth_memory, scratch_at), scratch, int(used), projected.work.depth,
                  place<uint32_t>(depth_memory, depth_at), projected.work.order,
                  place<int32_t>(depth_memory, order_at), &sorted, &depth, stream);
      sorted_depth = depth;
    }
    clock.mark();

    tile_start = make_as({tiles + 1}, at::kInt);
    Tensor pair_memory, values[2];
    void* sorted_keys = nullptr;
    int32_t* sorted_values = nullptr;
    if (count > 0) {
      const size_t scratch = sort_pairs_scratch(int(count), wide), key = wide ? 4 : 2;
      Layout layout;
      const size_t keys[2] = {layout.add(size_t(count), key), layout.add(size_t(count), key)};
      const size_t scratch_at = layout.add(scratch, 1);
      pair_memory = cuda_bytes(layout.bytes, real);
      for (Tensor& t : values) t = make_as({count}, at::kInt);
      if (keep) {
        compact.shape = make({used, 10});
        if (row > 0) compact.channels = make({used, row});
        drawn = splats_of(compact.shape, compact.channels);
      }
      emit(view, settings, int(used), sorted, projected.splats, projected.work, keep ? &drawn : nullptr, row,
           place<char>(pair_memory, keys[0]), wide, data<int32_t>(values[0]), tally.counters,
           tally.states + tally.blocks + 1, stream);
      const int key_bits = std::bit_width(uint64_t(tiles));
      sort_pairs(place<char>(pair_memory, scratch_at), scratch, int(count), key_bits, wide,
                 place<char>(pair_memory, keys[0]), place<char>(pair_memory, keys[1]), data<int32_t>(values[0]),
                 data<int32_t>(values[1]), &sorted_keys, &sorted_values, stream);
    }
    find_tiles(int(count), int(tiles), sorted_keys, wide, data<int32_t>(tile_start), stream);
    if (count > 0) splat = sorted_values == data<int32_t>(values[0]) ? values[0] : values[1];
  }
};

// Items by the group that each one names, negative: none; in the order of their numbers within a group.
class Grouped {
 public:
  Grouped() = default;
  Grouped(const Tensor& group_of, int64_t groups, cudaStream_t stream)
      : start_(at::empty({groups + 1}, group_of.options())) {
    const int64_t count = group_of.numel();
    void* sorted_keys = nullptr;
    if (count > 0) {
      const size_t scratch = sort_pairs_scratch(int(count), true);
      Layout layout;
      const size_t keys[2] = {layout.add(size_t(count), 4), layout.add(size_t(count), 4)};
      const size_t items[2] = {layout.add(size_t(count), 4), layout.add(size_t(count), 4)};
      const size_t scratch_at = layout.add(scratch, 1);
      memory_ = cuda_bytes(layout.bytes, group_of.options());
      number_keys(count, data<int32_t>(group_of), uint32_t(groups), place<uint32_t>(memory_, keys[0]),
                  place<int32_t>(memory_, items[0]), stream);
      sort_pairs(place<char>(memory_, scratch_at), scratch, int(count), std::bit_width(uint64_t(groups)), true,
                 place<char>(memory_, keys[0]), place<char>(memory_, keys[1]), place<int32_t>(memory_, items[0]),
                 place<int32_t>(memory_, items[1]), &sorted_keys, &items_, stream);
    }
    find_tiles(int(count), int(groups), sorted_keys, true, data<int32_t>(start_), stream);
  }
  Groups groups() const { return {data<int32_t>(start_), items_}; }

 private:
  Tensor memory_, start_;
  int32_t* items_ = nullptr;
};

// Image, radii, alpha, median depth, state for the backward pass, counts, seconds of the stages; see binding_cuda.cpp.
using Rendered = std::tuple<Tensor, Tensor, Tensor, Tensor, std::vector<Tensor>, std::vector<int64_t>,
                            std::vector<double>>;
Rendered render_on_cuda(const Inputs& in, at::ArrayRef<double> camera, int64_t width, int64_t height);

// Everything of one call that is not a tensor to differentiate by, and what its backward pass leaves and does.
struct DrawCall : torch::CustomClassHolder {
  std::vector<double> camera;
  int64_t width, height, sh_degree;
  double scale_modifier, eps2d;
  int64_t flags;
  OptionalTensor geom_indices, visible, background;
  int64_t gaussians = 0;
  Channels channels{};
  Tensor grad2d, absgrad2d;     // [0] until the backward pass makes them [N,2]; undefined: not wanted
  std::vector<Tensor> updated;  // nothing, or parameter and moments of sh_dc, of sh_rest; an empty one: not it
  std::vector<double> rates;    // six numbers for each
};

Tensor blend_backward_on_cuda(const DrawCall& call, const std::vector<Tensor>& saved, const Tensor& image_gradient,
                              const OptionalTensor& alpha_gradient, const OptionalTensor& median_gradient,
                              std::vector<double>& seconds);
std::vector<Tensor> project_backward_on_cuda(const Inputs& in, const DrawCall& call, const Tensor& drawn,
                                             const Tensor& row_memory, std::array<bool, kWantedCount> wanted,
                                             std::vector<double>& seconds);

}  // namespace sw::cuda
