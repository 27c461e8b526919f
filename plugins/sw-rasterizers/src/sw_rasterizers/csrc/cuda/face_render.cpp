// Pictures and radii; the work is done by the kernels beside.
#include "face.h"

#include "face_state.h"

namespace {

using namespace sw;        // NOLINT: one file
using namespace sw::cuda;  // NOLINT

void check_inputs(const render_call& call, const Way& way) {
  check_floats(call);
  if (call.quats != nullptr && reinterpret_cast<uintptr_t>(call.quats) % 16 != 0)
    refuse("sw_rasterizers: on CUDA quats must start at a multiple of 16 bytes; clone() it");
  const bool save = call.flags & kSave, as_bytes = call.flags & kBytes;
  if (as_bytes && !way.fast) refuse("8-bit images are drawn by the inference kernels only");
  if (way.fast && (way.general || way.surfels || save)) refuse("the inference kernels draw three colours, no gradients");
  if ((call.levels != nullptr) != as_bytes || (call.image != nullptr) == as_bytes) refuse("there is no place for the image");
  if ((call.maps != nullptr) != ((call.flags & kWithMaps) != 0)) refuse("maps and kWithMaps belong together");
  if (call.count > 0 && (call.drawn != nullptr) != save) refuse("drawn and kSave belong together");
}

// Launches the projection and the colours, and waits for the counts, while colours are still being computed.
void project_splats(const render_call& call, const View<float>& view, const Gaussians<float>& g, const Way& way,
                    const SplatMemory& memory, Mailbox& mailbox, Published* published, cudaStream_t stream) {
  mailbox.rest();
  *published = {};
  check(cudaMemsetAsync(memory.counters, 0, size_t(memory.cleared), stream));
  if (g.count == 0) return;
  const Settings settings = settings_of(call, nullptr);
  const auto launch = way.surfels ? project_surfels : cuda::project;
  launch(view, g, settings, memory.splats, memory.work, call.radii, call.drawn, memory.counters, memory.states,
         published, stream);
  mailbox.counted.record(stream);
  if (g.colors == nullptr || g.color_channels == 3)
    shade(view, g, settings, memory.splats, call.radii, call.drawn, memory.counters, published, stream);
  if (way.general)
    fill_channels(g, channels_of(call), memory.splats, memory.work, call.radii, call.drawn, memory.counters, published,
                  stream);
  mailbox.colored.record(stream);
  mailbox.under_way = true;
  check(cudaGetLastError());
  mailbox.counted.wait();
}

void render(render_call& call, cudaStream_t stream) {
  const auto view = view_of<float>(call);
  const auto g = gaussians_of<float>(call);
  const auto channels = channels_of(call);
  if (call.channels != channels.total()) refuse("an image of %lld channels", (long long)call.channels);
  const Settings settings = settings_of(call, nullptr);
  const Way way(view, channels.total(), channels.colors, call.flags);
  check_inputs(call, way);
  const bool count_work = call.flags & kCount;
  const SplatMemory memory(call.splats, g.count, way, call.flags);
  memory.layout.check("splats", call.splat_bytes);
  const ScratchMemory scratch(call.scratch, view, way, call.splat_room, call.room);
  scratch.layout.check("scratch", call.scratch_bytes);
  const ListMemory kept(call.lists, view, way, call.splat_room, call.room, call.flags);
  kept.layout.check("lists", call.list_bytes);
  auto* const published = reinterpret_cast<Published*>(call.mailbox);
  static_assert(sizeof(Published) <= 128);
  Mailbox& mailbox = Mailbox::of(call.head.device);

  StageClock clock{count_work, stream};
  clock.mark();
  if (!call.projected) project_splats(call, view, g, way, memory, mailbox, published, stream);
  clock.mark();
  call.used = published->splats, call.pairs = published->pairs;
  call.complete = call.used <= call.splat_room && call.pairs <= call.room;
  call.project_seconds = call.projected ? 0. : clock.seconds(0);
  call.sort_seconds = call.bin_seconds = call.blend_seconds = 0.;
  if (!call.complete) return;

  const int used = int(call.used), pairs = int(call.pairs);
  const int64_t tiles = tiles_of(view);
  const bool wide = ScratchMemory::wide(tiles);
  int32_t* sorted = nullptr;
  uint32_t* sorted_depth = nullptr;
  if (used > 0)
    depth_order(scratch.depth_sort, depth_order_scratch(used), used, memory.work.depth, scratch.depth,
                memory.work.order, scratch.order, &sorted, &sorted_depth, stream);
  clock.mark();
  const bool compact = kept.splats.shape != nullptr && pairs > 0;
  const Splats& drawn = compact ? kept.splats : memory.splats;
  void* sorted_keys = nullptr;
  int32_t* sorted_values = call.first;
  if (pairs > 0) {
    emit(view, settings, used, sorted, memory.splats, memory.work, compact ? &kept.splats : nullptr, way.row,
         scratch.keys[0], wide, call.first, memory.counters, memory.states + memory.blocks + 1, stream);
    sort_pairs(scratch.pair_sort, sort_pairs_scratch(pairs, wide), pairs, std::bit_width(uint64_t(tiles)), wide,
               scratch.keys[0], scratch.keys[1], call.first, call.second, &sorted_keys, &sorted_values, stream);
  }
  find_tiles(pairs, int(tiles), sorted_keys, wide, kept.tile_start, stream);
  call.kept_in = sorted_values == call.first ? 0 : 1;
  clock.mark();

  const TileLists lists{kept.tile_start, pairs > 0 ? sorted_values : nullptr};
  Image image = kept.image(call, tiles, pairs);
  image.image = call.image, image.alpha = call.alpha, image.median = call.median;
  Counters* const counters = count_work ? memory.counters : nullptr;
  if (way.surfels)
    blend_surfels(view, settings.tight, drawn, lists, {image, call.maps, kept.pixels}, counters, stream);
  else if (way.fast)
    (call.flags & kFlash ? blend_flash : blend_tcgs)(view, drawn, lists, image, call.levels, stream);
  else if (way.few)
    blend_few(way.split && pairs > 0 ? scratch.few : nullptr, view, drawn, lists, image, stream);
  else
    blend(view, drawn, lists, image, way.general, counters, sorted_depth, stream);
  check(cudaGetLastError());
  clock.mark();

  mailbox.rest();  // long past by now
  call.evaluated = call.blended = -1;
  if (count_work) {
    Counters now{};
    check(cudaMemcpyAsync(&now, memory.counters, sizeof now, cudaMemcpyDeviceToHost, stream));
    check(cudaStreamSynchronize(stream));
    call.evaluated = int64_t(now.evaluated), call.blended = int64_t(now.blended);
  }
  const auto bad = int64_t(published->bad_colors);
  call.seen = published->visible - bad, call.invalid = published->invalid + bad;
  call.sort_seconds = clock.seconds(1), call.bin_seconds = clock.seconds(2), call.blend_seconds = clock.seconds(3);
}

}  // namespace

SW_OPERATION(sw_rasterizers_cuda, plan_render) {
  return guarded_on_gpu(call, [&](cudaStream_t) {
    constexpr int64_t most = std::numeric_limits<int32_t>::max();
    if (call->width < 1 || call->height < 1 || call->width > 1 << 20 || call->height > 1 << 20 || call->count < 0 ||
        call->count >= most || call->splat_room < 0 || call->splat_room >= most || call->room < 0 || call->room >= most)
      refuse("%lld Gaussians, %lld splats, %lld pairs on %lld x %lld pixels", (long long)call->count,
             (long long)call->splat_room, (long long)call->room, (long long)call->width, (long long)call->height);
    View<float> view{};
    view.width = int(call->width), view.height = int(call->height);
    const Way way(view, call->channels, call->color_channels, call->flags);
    call->splat_bytes = SplatMemory(nullptr, call->count, way, call->flags).layout.bytes;
    call->scratch_bytes = ScratchMemory(nullptr, view, way, call->splat_room, call->room).layout.bytes;
    call->list_bytes = ListMemory(nullptr, view, way, call->splat_room, call->room, call->flags).layout.bytes;
  });
}

SW_OPERATION(sw_rasterizers_cuda, render) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) { render(*call, stream); });
}

SW_OPERATION(sw_rasterizers_cuda, visible_radii) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    check_floats(*call);
    const auto view = view_of<float>(*call);
    const auto g = geometry_of<float>(*call);
    const auto launch = call->flags & kSurfels ? visible_surfel_radii : cuda::visible_radii;
    if (g.count > 0) launch(view, g, settings_of(*call, nullptr), call->radii, stream);
  });
}
