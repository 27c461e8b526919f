// What the operations of face.h leave for each other in memory of the caller's, and how the host waits for the device.
#pragma once

#include <splatwizard/cuda_face.h>

#include <bit>
#include <utility>
#include <vector>

#include "../face_inputs.h"
#include "score_kernels.h"
#include "surfel_kernels.h"

namespace sw::cuda {

using splatwizard::check;
using splatwizard::guarded_on_gpu;

class Event {
 public:
  explicit Event(bool timed) { check(cudaEventCreateWithFlags(&event_, timed ? cudaEventDefault : cudaEventDisableTiming)); }
  ~Event() {
    if (event_ != nullptr) cudaEventDestroy(event_);
  }
  Event(Event&& other) noexcept : event_(std::exchange(other.event_, nullptr)) {}
  Event& operator=(Event&&) = delete;

  void record(cudaStream_t stream) { check(cudaEventRecord(event_, stream)); }
  void wait() const { check(cudaEventSynchronize(event_)); }
  double seconds_to(const Event& later) const {
    float milliseconds = 0;
    check(cudaEventElapsedTime(&milliseconds, event_, later.event_));
    return 1e-3 * milliseconds;
  }

 private:
  cudaEvent_t event_ = nullptr;
};

// Seconds between marks, measured on the device; only where they are asked for, since reading them waits.
struct StageClock {
  bool on;
  cudaStream_t stream;
  std::vector<Event> events{};
  void mark() {
    if (!on) return;
    events.emplace_back(true);
    events.back().record(stream);
  }
  // Between marks i and i + 1; of the last ones it waits.
  double seconds(size_t i) const {
    if (!on || i + 1 >= events.size()) return 0.;
    events.back().wait();
    return events[i].seconds_to(events[i + 1]);
  }
};

// The events that tell when the device has written into a thread's mailbox, one of them for each GPU; never freed, since
// a thread may outlive the driver.
struct Mailbox {
  Event counted{false}, colored{false};
  bool under_way = false;  // the device may still write: a call that ended early left it so

  void rest() {
    if (under_way) colored.wait();
    under_way = false;
  }
  static Mailbox& of(int device) {
    static thread_local std::vector<Mailbox*> boxes;
    if (boxes.size() <= size_t(device)) boxes.resize(size_t(device) + 1);
    if (boxes[size_t(device)] == nullptr) boxes[size_t(device)] = new Mailbox;
    return *boxes[size_t(device)];
  }
};

template <class Call>
void check_floats(const Call& call) {
  if (call.real_bytes != 4) refuse("sw_rasterizers: on CUDA numbers must be float32");
}

// How a picture is drawn.
struct Way {
  bool surfels, general, fast, few, cut, split;
  int row;  // numbers of a splat beside its shape

  Way(const View<float>& view, int64_t channels, int64_t colors, int64_t flags) {
    const int64_t tiles = tiles_of(view);
    surfels = flags & kSurfels, fast = flags & (kFlash | kTensorCores);
    general = !surfels && (channels != 3 || colors != 3 || (flags & kMedianDepth));
    few = !surfels && !fast && !general && !(flags & kCount) && tiles < kFewTiles;
    cut = few && (flags & kSave) && !(flags & kForScores);
    split = few && tiles < kSplitTiles;
    row = surfels ? kPlane : general ? int(channels) : 0;
  }
};

// Of the projection, for up to `count` splats: `splats`.
struct SplatMemory {
  Counters* counters;
  uint64_t* states;  // of the projection's prefix sums, then of the emission's
  int64_t blocks, cleared;
  Splats splats{};
  SplatWork work{};
  Layout layout;

  SplatMemory(uint8_t* memory, int64_t count, const Way& way, int64_t flags)
      : blocks((count + kProjectThreads - 1) / kProjectThreads), layout{memory} {
    counters = layout.take<Counters>(1);
    states = layout.take<uint64_t>(2 * (blocks + 1));
    cleared = layout.bytes;
    splats.shape = layout.take<float4>(2 * count);
    splats.tail = layout.take<float2>(count);
    splats.channels = layout.take<float>(count * way.row);
    work.extent = layout.take<float2>(count);
    work.depth = layout.take<uint32_t>(count);
    work.order = layout.take<int32_t>(count);
    work.tiles = layout.take<int32_t>(count);
    work.radius = layout.take<int32_t>(flags & kTight ? 0 : count);
  }
};

// Sorting, and the pieces of small pictures.
struct ScratchMemory {
  uint32_t* depth;
  int32_t* order;
  uint8_t *depth_sort, *keys[2], *pair_sort, *few;
  Layout layout;

  ScratchMemory(uint8_t* memory, const View<float>& view, const Way& way, int64_t splats, int64_t pairs)
      : layout{memory} {
    const int64_t tiles = tiles_of(view);
    depth = layout.take<uint32_t>(splats);
    order = layout.take<int32_t>(splats);
    depth_sort = layout.take<uint8_t>(int64_t(depth_order_scratch(int(splats))));
    for (uint8_t*& each : keys) each = layout.take<uint8_t>(pairs * (wide(tiles) ? 4 : 2));
    pair_sort = layout.take<uint8_t>(int64_t(sort_pairs_scratch(int(pairs), wide(tiles))));
    few = layout.take<uint8_t>(way.split ? int64_t(few_scratch(tiles, piece_count(tiles, pairs))) : 0);
  }
  // One key more than tiles: for places that no tile claims.
  static bool wide(int64_t tiles) { return tiles >= 0xffff; }
};

// The pairs by tile, nearest first, the splats in depth order, which they count, and what is kept of the pixels: `lists`.
struct ListMemory {
  int32_t* tile_start;
  Splats splats{};
  float* transmittance;
  int32_t *last, *median_splat;
  SurfelPixels<float> pixels{};
  Pieces pieces{};
  Layout layout;

  ListMemory(uint8_t* memory, const View<float>& view, const Way& way, int64_t room, int64_t pairs, int64_t flags)
      : layout{memory} {
    const bool save = flags & kSave, median = flags & kMedianDepth;
    const int64_t tiles = tiles_of(view), size = int64_t(view.width) * view.height;
    const int64_t kept = save || (median && !way.surfels) ? room : 0;
    const int64_t with_maps = save && (flags & kWithMaps) ? size : 0;
    tile_start = layout.take<int32_t>(tiles + 1);
    splats.shape = layout.take<float4>(2 * kept);
    splats.tail = layout.take<float2>(kept);
    splats.channels = layout.take<float>(kept * way.row);
    transmittance = layout.take<float>(save ? size : 0);
    last = layout.take<int32_t>(save ? size : 0);
    median_splat = layout.take<int32_t>(save && median && !way.surfels ? size : 0);
    for (float** field : {&pixels.first, &pixels.sum, &pixels.square}) *field = layout.take<float>(with_maps);
    pixels.median = layout.take<int32_t>(with_maps);
    const int64_t places = piece_count(tiles, pairs);
    pieces.behind = layout.take<float4>(way.cut || way.split ? places * kTile * kTile : 0);
    pieces.where = layout.take<int2>(way.cut ? places : 0);
  }
  // Of `render`, for what reads it.
  template <class Call>
  static ListMemory of(const Call& call, const View<float>& view, const Way& way) {
    const ListMemory found(call.lists, view, way, call.splat_room, call.room, call.flags);
    found.layout.check("lists", call.list_bytes);
    if (!(call.flags & kSave) || call.pairs < 0 || call.pairs > call.room || call.used < 0 || call.used > call.splat_room)
      refuse("sw_rasterizers: the forward pass kept no state for this");
    return found;
  }

  // `pairs`: how many there are.
  template <class Call>
  Image image(const Call& call, int64_t tiles, int64_t pairs) const {
    Image image{};
    image.channels = int(call.channels), image.color_channels = int(call.color_channels);
    image.background_is_image = call.backdrop != nullptr;
    image.background = numbers<float>(image.background_is_image ? call.backdrop : call.background);
    image.transmittance = transmittance, image.last = last, image.median_splat = median_splat;
    if (pairs > 0 && pieces.behind != nullptr) image.pieces = {pieces.behind, pieces.where, piece_count(tiles, pairs)};
    return image;
  }
};

// Items by the group that each one names, negative: none; in the order of their numbers within a group.
struct GroupMemory {
  int32_t *start, *items[2];
  uint32_t* keys[2];
  uint8_t* sort;
  int64_t count, groups, sort_bytes;

  GroupMemory(Layout& layout, int64_t count, int64_t groups)
      : count(count), groups(groups), sort_bytes(count > 0 ? int64_t(sort_pairs_scratch(int(count), true)) : 0) {
    start = layout.take<int32_t>(groups + 1);
    for (uint32_t*& each : keys) each = layout.take<uint32_t>(count);
    for (int32_t*& each : items) each = layout.take<int32_t>(count);
    sort = layout.take<uint8_t>(sort_bytes);
  }
  Groups of(const int32_t* group_of, cudaStream_t stream) const {
    void* sorted_keys = nullptr;
    int32_t* sorted = nullptr;
    if (count > 0) {
      number_keys(count, group_of, uint32_t(groups), keys[0], items[0], stream);
      sort_pairs(sort, size_t(sort_bytes), int(count), std::bit_width(uint64_t(groups)), true, keys[0], keys[1],
                 items[0], items[1], &sorted_keys, &sorted, stream);
    }
    find_tiles(int(count), int(groups), sorted_keys, true, start, stream);
    return {start, sorted};
  }
};

// Sums of pairs that are added in one order.
struct SumMemory {
  Layout layout;
  float* pair_sums;
  GroupMemory pairs_of_splat, pixels_of_gaussian;

  // `floats` a pair; no pixels: none are grouped.
  SumMemory(uint8_t* memory, int64_t pairs, int64_t splats, int64_t floats, int64_t pixels, int64_t gaussians)
      : layout{memory},
        pair_sums(layout.take<float>(pairs * floats)),
        pairs_of_splat(layout, pairs, splats),
        pixels_of_gaussian(layout, pixels, pixels > 0 ? gaussians : 0) {}

  Ordered ordered(const int32_t* splat_of_pair, const int32_t* gaussian_of_pixel, cudaStream_t stream) const {
    Ordered found{};
    found.pair_sums = pair_sums, found.pairs = pairs_of_splat.count, found.splats = pairs_of_splat.groups;
    found.pairs_of_splat = pairs_of_splat.of(splat_of_pair, stream);
    if (gaussian_of_pixel == nullptr) return found;
    found.gaussians = pixels_of_gaussian.groups;
    found.pixels_of_gaussian = pixels_of_gaussian.of(gaussian_of_pixel, stream);
    return found;
  }
};

// Sums in one order where they are asked for, with the memory of a call.
template <class Call>
Ordered ordered_of(const Call& call, int64_t floats, const int32_t* gaussian_of_pixel, int64_t pixels,
                   cudaStream_t stream) {
  if (!(call.flags & kOrdered) || call.pairs == 0) return {};
  const int64_t grouped = gaussian_of_pixel == nullptr ? 0 : pixels;
  const SumMemory memory(call.scratch, call.pairs, call.used, floats, grouped, call.count);
  memory.layout.check("scratch", call.scratch_bytes);
  return memory.ordered(call.pair_splats, gaussian_of_pixel, stream);
}

}  // namespace sw::cuda
