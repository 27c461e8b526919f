// The ops torch.ops.sw_rasterizers.*surfel*: memory, types and shapes; the work is done in cpu/surfel_*.cpp.
#include <ATen/Parallel.h>
#include <torch/library.h>

#include <tuple>
#include <vector>

#include "binding_memory.h"
#include "binding_surfel.h"
#include "cpu/surfel_kernels.h"

namespace {

using namespace sw;  // NOLINT: one file

// clang-format off
enum Saved {  // the state that the backward pass needs
  kRecords, kPlanes, kIndex, kPerChunk, kRuns, kColorSlope, kClamped, kTileStart, kSlot, kOrigin, kBlocksOfPair,
  kTransmittance, kLast, kFirst, kSum, kSquare, kMedian, kSavedCount
};
// clang-format on

template <class S>
Slots<S> slots_of(const std::vector<Tensor>& saved) {
  return {data<S>(saved[kRecords]),    data<int32_t>(saved[kIndex]), data<int32_t>(saved[kPerChunk]),
          data<PairRun>(saved[kRuns]), nullptr,                      data<S>(saved[kColorSlope]),
          data<uint8_t>(saved[kClamped]), nullptr};
}

template <class S>
Pairs<S> pairs_of(const std::vector<Tensor>& saved) {
  return {saved[kSlot].numel(), data<int64_t>(saved[kTileStart]), data<int32_t>(saved[kSlot]),
          data<int32_t>(saved[kOrigin]), data<uint32_t>(saved[kBlocksOfPair])};
}

template <class S>
SurfelCanvas<S> canvas_of(const Inputs& in, const std::vector<Tensor>& saved) {
  SurfelCanvas<S> target{};
  target.canvas.channels = target.canvas.color_channels = 3;
  target.canvas.background = data<S>(in.background);
  target.canvas.background_is_image = in.background.has_value() && in.background->dim() == 3;
  target.canvas.transmittance = data<S>(saved[kTransmittance]);
  target.canvas.last = data<int32_t>(saved[kLast]);
  target.pixels = {data<S>(saved[kFirst]), data<S>(saved[kSum]), data<S>(saved[kSquare]),
                   data<int32_t>(saved[kMedian])};
  return target;
}

struct Rendered {
  Tensor image, radii, alpha, maps;
  std::vector<Tensor> saved;
  std::vector<int64_t> counts;
  std::vector<double> seconds;
};

template <class S>
Rendered render_as(const Inputs& in, at::ArrayRef<double> camera, int64_t width, int64_t height) {
  const auto view = View<S>::from(camera.data(), int(width), int(height));
  const auto g = in.gaussians<S>();
  const auto settings = in.settings();
  const bool save = in.flags & kSave, maps = in.flags & kWithMaps;
  const int64_t n = g.count, chunks = (n + kChunk - 1) / kChunk;
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const auto real = in.means.options().requires_grad(false);
  const auto make = [&](at::IntArrayRef shape) { return make_tensor(shape, real); };
  const auto make_as = [&](at::IntArrayRef shape, at::ScalarType type) { return make_tensor(shape, real.dtype(type)); };

  Rendered out;
  std::vector<Tensor> saved(kSavedCount);
  Clock clock;
  saved[kRecords] = make({n, kRecord});
  saved[kPlanes] = make({n, kPlane});
  saved[kIndex] = make_as({n}, at::kInt);
  saved[kPerChunk] = make_as({chunks}, at::kInt);
  saved[kRuns] = make_as({n, 2}, at::kInt);
  saved[kClamped] = make_as({n}, at::kByte);
  saved[kColorSlope] = make({save && g.colors == nullptr && g.sh_degree > 0 ? n : 0, 9});
  out.radii = make_as({n}, at::kInt);
  std::vector<std::vector<int32_t>> tile_lists(static_cast<size_t>(chunks));
  auto slots = slots_of<S>(saved);
  slots.tile_lists = tile_lists.data();
  S* planes = data<S>(saved[kPlanes]);
  int64_t seen[3] = {0, 0, 0};
  const int64_t used =
      n == 0 ? 0 : SW_SELECT(project_surfels<S>)(view, g, settings, slots, planes, data<int32_t>(out.radii), seen);
  const int64_t count = SW_SELECT(count_pairs<S>)(n, slots);
  check_pairs_on_cpu(seen[2], settings);
  out.seconds.push_back(clock.lap());

  Tensor order = make_as({used}, at::kInt);
  if (used > 0) SW_SELECT(depth_order<S>)(n, used, slots, settings.threads, data<int32_t>(order));
  out.seconds.push_back(clock.lap());

  saved[kTileStart] = make_as({tiles + 1}, at::kLong);
  saved[kSlot] = make_as({count}, at::kInt);
  saved[kOrigin] = make_as({save ? count : 0}, at::kInt);
  saved[kBlocksOfPair] = make_as({save ? count : 0}, at::kInt);
  const auto pairs = pairs_of<S>(saved);
  SW_SELECT(bin_pairs<S>)(view, settings, n, used, slots, data<int32_t>(order), pairs);
  out.seconds.push_back(clock.lap());

  const int64_t kept = save && maps ? tiles : 0;
  saved[kTransmittance] = make({tiles, kTilePixels});
  saved[kLast] = make_as({tiles, kTilePixels}, at::kInt);
  for (const int field : {kFirst, kSum, kSquare}) saved[size_t(field)] = make({kept, kTilePixels});
  saved[kMedian] = make_as({kept, kTilePixels}, at::kInt);
  out.image = make({3, height, width});
  out.alpha = make({(in.flags & kAlphaMap) ? 1 : 0, height, width});
  out.maps = make({maps ? kMaps : 0, height, width});
  int64_t counters[2] = {-1, -1};
  auto target = canvas_of<S>(in, saved);
  target.canvas.image = data<S>(out.image), target.canvas.alpha = data<S>(out.alpha);
  target.maps = data<S>(out.maps);
  if (in.flags & kCount) target.canvas.counters = counters;
  SW_SELECT(blend_surfels<S>)(view, settings, slots, planes, pairs, target);
  out.seconds.push_back(clock.lap());
  out.counts = {seen[0], count, counters[0], counters[1], seen[1]};
  if (save) out.saved = std::move(saved);
  return out;
}

std::tuple<Tensor, Tensor, Tensor, Tensor, std::vector<Tensor>, std::vector<int64_t>, std::vector<double>> render(
    const Tensor& means, const Tensor& opacities, const OptionalTensor& scales, const OptionalTensor& quats,
    const OptionalTensor& sh, const OptionalTensor& sh_dc, const OptionalTensor& sh_rest, const OptionalTensor& colors,
    const OptionalTensor& visible, const OptionalTensor& background, at::ArrayRef<double> camera, int64_t width,
    int64_t height, int64_t sh_degree, double scale_modifier, int64_t flags) {
  const SurfelInputs in(means, opacities, scales, quats, sh, sh_dc, sh_rest, colors, visible, background, sh_degree,
                        scale_modifier, flags);
  in.check_all(camera, width, height);
  auto r = means.scalar_type() == at::kDouble ? render_as<double>(in, camera, width, height)
                                              : render_as<float>(in, camera, width, height);
  return {r.image, r.radii, r.alpha, r.maps, std::move(r.saved), std::move(r.counts), std::move(r.seconds)};
}

template <class S>
std::tuple<std::vector<Tensor>, std::vector<double>> backward_as(
    const Inputs& in, at::ArrayRef<double> camera, int64_t width, int64_t height, const std::vector<Tensor>& saved,
    const Tensor& image_gradient, const OptionalTensor& alpha_gradient, const OptionalTensor& maps_gradient,
    const std::array<bool, kSurfelWanted>& wanted) {
  const auto view = View<S>::from(camera.data(), int(width), int(height));
  const auto g = in.gaussians<S>();
  const auto settings = in.settings();
  const auto slots = slots_of<S>(saved);
  const auto pairs = pairs_of<S>(saved);
  const auto real = in.means.options().requires_grad(false);
  const CanvasGradient<S> gradient{data<S>(image_gradient), data<S>(alpha_gradient), nullptr};
  const bool maps = maps_gradient.has_value();

  Clock clock;
  std::vector<double> seconds;
  Tensor sums = make_tensor({pairs.count, surfel_columns(maps)}, real);
  SW_SELECT(blend_surfels_backward<S>)(view, settings, slots, data<S>(saved[kPlanes]), pairs, canvas_of<S>(in, saved),
                                       gradient, data<S>(maps_gradient), data<S>(sums));
  seconds.push_back(clock.lap());

  SurfelGradients found(in, wanted, [&](at::IntArrayRef shape) { return make_tensor(shape, real); });
  if (g.count > 0)
    SW_SELECT(project_surfels_backward<S>)(view, g, settings, slots, data<S>(sums), maps, found.pointers<S>());
  seconds.push_back(clock.lap());
  return {std::move(found.tensors), std::move(seconds)};
}

std::tuple<std::vector<Tensor>, std::vector<double>> render_backward(
    const Tensor& means, const Tensor& opacities, const OptionalTensor& scales, const OptionalTensor& quats,
    const OptionalTensor& sh, const OptionalTensor& sh_dc, const OptionalTensor& sh_rest, const OptionalTensor& colors,
    const OptionalTensor& visible, const OptionalTensor& background, at::ArrayRef<double> camera, int64_t width,
    int64_t height, int64_t sh_degree, double scale_modifier, int64_t flags, std::vector<Tensor> saved,
    const Tensor& image_gradient, const OptionalTensor& alpha_gradient, const OptionalTensor& maps_gradient,
    std::array<bool, kSurfelWanted> wanted) {
  const SurfelInputs in(means, opacities, scales, quats, sh, sh_dc, sh_rest, colors, visible, background, sh_degree,
                        scale_modifier, flags);
  in.check_all(camera, width, height);
  TORCH_CHECK(saved.size() == kSavedCount, "sw_rasterizers: the forward pass kept no state for the backward pass");
  in.check_shape("image_gradient", image_gradient, {3, height, width});
  in.check_shape("alpha_gradient", alpha_gradient, {1, height, width});
  in.check_shape("maps_gradient", maps_gradient, {kMaps, height, width});
  TORCH_CHECK(!maps_gradient.has_value() || (flags & kWithMaps), "sw_rasterizers: no maps were drawn");
  return means.scalar_type() == at::kDouble ? backward_as<double>(in, camera, width, height, saved, image_gradient,
                                                                  alpha_gradient, maps_gradient, wanted)
                                            : backward_as<float>(in, camera, width, height, saved, image_gradient,
                                                                 alpha_gradient, maps_gradient, wanted);
}

template <class S>
void radii_as(const Inputs& in, at::ArrayRef<double> camera, int64_t width, int64_t height, Tensor& radii) {
  const auto view = View<S>::from(camera.data(), int(width), int(height));
  if (in.means.size(0) > 0)
    SW_SELECT(visible_surfel_radii<S>)(view, in.gaussians<S>(), in.settings(), data<int32_t>(radii));
}

Tensor visible_radii(const Tensor& means, const OptionalTensor& scales, const OptionalTensor& quats,
                     const OptionalTensor& visible, at::ArrayRef<double> camera, int64_t width, int64_t height) {
  const OptionalTensor colors = means;
  const Tensor opacities = at::empty({0}, means.options());
  const SurfelInputs in(means, opacities, scales, quats, kNone, kNone, kNone, colors, visible, kNone, 0, 1, 0);
  in.check_geometry();
  TORCH_CHECK(camera.size() == 18 && width > 0 && height > 0, "sw_rasterizers: malformed camera");
  Tensor radii = at::empty({means.size(0)}, means.options().dtype(at::kInt).requires_grad(false));
  means.scalar_type() == at::kDouble ? radii_as<double>(in, camera, width, height, radii)
                                     : radii_as<float>(in, camera, width, height, radii);
  return radii;
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sw_rasterizers, m) {
  m.def(
      "render_surfels(Tensor means, Tensor opacities, Tensor? scales, Tensor? quats, Tensor? sh, Tensor? sh_dc, "
      "Tensor? sh_rest, Tensor? colors, Tensor? visible, Tensor? background, float[] camera, int width, int height, "
      "int sh_degree, float scale_modifier, int flags) "
      "-> (Tensor image, Tensor radii, Tensor alpha, Tensor maps, Tensor[] saved, int[] counts, float[] seconds)");
  m.def(
      "render_surfels_backward(Tensor means, Tensor opacities, Tensor? scales, Tensor? quats, Tensor? sh, "
      "Tensor? sh_dc, Tensor? sh_rest, Tensor? colors, Tensor? visible, Tensor? background, float[] camera, "
      "int width, int height, int sh_degree, float scale_modifier, int flags, Tensor[] saved, Tensor image_gradient, "
      "Tensor? alpha_gradient, Tensor? maps_gradient, bool[9] wanted) -> (Tensor[] gradients, float[] seconds)");
  m.def(
      "visible_surfel_radii(Tensor means, Tensor? scales, Tensor? quats, Tensor? visible, float[] camera, int width, "
      "int height) -> Tensor");
}

TORCH_LIBRARY_IMPL(sw_rasterizers, CPU, m) {
  m.impl("render_surfels", render);
  m.impl("render_surfels_backward", render_backward);
  m.impl("visible_surfel_radii", visible_radii);
}
