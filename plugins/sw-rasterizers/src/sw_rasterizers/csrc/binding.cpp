// The ops torch.ops.sw_rasterizers.*: memory, types and shapes; the work is done in cpu/.
#include <ATen/Parallel.h>
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <torch/library.h>

#include <tuple>
#include <vector>

#include "binding.h"
#include "binding_memory.h"
#include "cpu/kernels.h"

namespace {

using namespace sw;  // NOLINT: one file

// clang-format off
enum Saved {  // the state that the backward pass needs
  kRecords, kIndex, kPerChunk, kRuns, kColorSlope, kClamped, kChannels, kTileStart, kSlot, kOrigin,
  kBlocksOfPair, kTransmittance, kLast, kMedianPair, kSavedCount
};
// clang-format on

template <class S>
sw::Slots<S> slots_of(const std::vector<Tensor>& saved) {
  return {data<S>(saved[kRecords]),        data<int32_t>(saved[kIndex]), data<int32_t>(saved[kPerChunk]),
          data<sw::PairRun>(saved[kRuns]), nullptr,                      data<S>(saved[kColorSlope]),
          data<uint8_t>(saved[kClamped]),  data<S>(saved[kChannels])};
}

template <class S>
sw::Pairs<S> pairs_of(const std::vector<Tensor>& saved) {
  return {saved[kSlot].numel(), data<int64_t>(saved[kTileStart]), data<int32_t>(saved[kSlot]),
          data<int32_t>(saved[kOrigin]), data<uint32_t>(saved[kBlocksOfPair])};
}

template <class S>
sw::Canvas<S> canvas_of(const Inputs& in, const std::vector<Tensor>& saved) {
  sw::Canvas<S> canvas{};
  canvas.channels = in.channels().total(), canvas.color_channels = in.channels().colors;
  canvas.background = data<S>(in.background);
  canvas.background_is_image = in.background.has_value() && in.background->dim() == 3;
  canvas.transmittance = data<S>(saved[kTransmittance]);
  canvas.last = data<int32_t>(saved[kLast]);
  canvas.median_pair = data<int32_t>(saved[kMedianPair]);
  return canvas;
}

struct Rendered {
  Tensor image, radii, alpha, median;
  std::vector<Tensor> saved;
  std::vector<int64_t> counts;
  std::vector<double> seconds;
};

template <class S>
Rendered render_as(const Inputs& in, at::ArrayRef<double> camera, int64_t width, int64_t height) {
  const auto view = sw::View<S>::from(camera.data(), int(width), int(height));
  const auto g = in.gaussians<S>();
  const auto settings = in.settings();
  const auto channels = in.channels();
  const bool save = in.flags & kSave;
  const int64_t n = g.count, chunks = (n + sw::kChunk - 1) / sw::kChunk, total = channels.total();
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const auto real = in.means.options().requires_grad(false);
  const auto make = [&](at::IntArrayRef shape) { return make_tensor(shape, real); };
  const auto make_as = [&](at::IntArrayRef shape, at::ScalarType type) { return make_tensor(shape, real.dtype(type)); };

  Rendered out;
  std::vector<Tensor> saved(kSavedCount);
  Clock clock;
  saved[kRecords] = make({n, sw::kRecord});
  saved[kIndex] = make_as({n}, at::kInt);
  saved[kPerChunk] = make_as({chunks}, at::kInt);
  saved[kRuns] = make_as({n, 2}, at::kInt);
  saved[kClamped] = make_as({n}, at::kByte);
  saved[kColorSlope] = make({save && g.colors == nullptr && g.sh_degree > 0 ? n : 0, 9});
  saved[kChannels] = make({in.plain() ? 0 : n, total});
  out.radii = make_as({n}, at::kInt);
  std::vector<std::vector<int32_t>> tile_lists(static_cast<size_t>(chunks));
  auto slots = slots_of<S>(saved);
  slots.tile_lists = tile_lists.data();
  int64_t seen[3] = {0, 0, 0};
  const int64_t used =
      n == 0 ? 0 : SW_SELECT(project_gaussians<S>)(view, g, settings, channels, slots, data<int32_t>(out.radii), seen);
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

  const bool median = settings.median_depth;
  saved[kTransmittance] = make({tiles, sw::kTilePixels});
  saved[kLast] = make_as({tiles, sw::kTilePixels}, at::kInt);
  saved[kMedianPair] = make_as({save && median ? height : 0, width}, at::kInt);
  out.image = make({total, height, width});
  out.alpha = make({(in.flags & kAlphaMap) ? 1 : 0, height, width});
  out.median = make({median ? 1 : 0, height, width});
  int64_t counters[2] = {-1, -1};
  auto canvas = canvas_of<S>(in, saved);
  canvas.image = data<S>(out.image), canvas.alpha = data<S>(out.alpha), canvas.median = data<S>(out.median);
  if (in.flags & kCount) canvas.counters = counters;
  SW_SELECT(blend<S>)(view, settings, slots, pairs, canvas);
  out.seconds.push_back(clock.lap());
  out.counts = {seen[0], count, counters[0], counters[1], seen[1]};
  if (save) out.saved = std::move(saved);
  return out;
}

std::tuple<Tensor, Tensor, Tensor, Tensor, std::vector<Tensor>, std::vector<int64_t>, std::vector<double>> render(
    const Tensor& means, const Tensor& opacities, const OptionalTensor& scales, const OptionalTensor& quats,
    const OptionalTensor& cov3d, const OptionalTensor& sh, const OptionalTensor& sh_dc, const OptionalTensor& sh_rest,
    const OptionalTensor& colors, const OptionalTensor& features, const OptionalTensor& scale_factors,
    const OptionalTensor& geom_indices, const OptionalTensor& visible, const OptionalTensor& background, at::ArrayRef<double> camera, int64_t width, int64_t height, int64_t sh_degree,
    double scale_modifier, double eps2d, int64_t flags) {
  const Inputs in{means,    opacities, scales,     quats,     cov3d,          sh,    sh_dc, sh_rest, colors,
                  features, visible,   background, sh_degree, scale_modifier, eps2d, flags, 3,  scale_factors,
                  geom_indices};
  in.check();
  TORCH_CHECK(camera.size() == 18 && width > 0 && height > 0, "sw_rasterizers: malformed camera");
  auto r = means.scalar_type() == at::kDouble ? render_as<double>(in, camera, width, height)
                                              : render_as<float>(in, camera, width, height);
  return {r.image, r.radii, r.alpha, r.median, std::move(r.saved), std::move(r.counts), std::move(r.seconds)};
}

template <class S>
std::tuple<std::vector<Tensor>, std::vector<double>> backward_as(
    const Inputs& in, at::ArrayRef<double> camera, int64_t width, int64_t height, const std::vector<Tensor>& saved,
    const Tensor& image_gradient, const OptionalTensor& alpha_gradient, const OptionalTensor& median_gradient,
    const std::array<bool, kWantedCount>& wanted) {
  const auto view = sw::View<S>::from(camera.data(), int(width), int(height));
  const auto g = in.gaussians<S>();
  auto settings = in.settings();
  settings.median_depth = median_gradient.has_value();
  const auto channels = in.channels();
  const auto slots = slots_of<S>(saved);
  const auto pairs = pairs_of<S>(saved);
  const auto real = in.means.options().requires_grad(false);
  const sw::CanvasGradient<S> gradient{data<S>(image_gradient), data<S>(alpha_gradient), data<S>(median_gradient)};
  const int64_t columns = sw::pair_columns(in.plain(), channels.total(), settings.absgrad, settings.median_depth);

  Clock clock;
  std::vector<double> seconds;
  Tensor sums = make_tensor({pairs.count, columns}, real);
  SW_SELECT(blend_backward<S>)(view, settings, slots, pairs, canvas_of<S>(in, saved), gradient,
                               settings.detach_features ? channels.features : 0, data<S>(sums));
  seconds.push_back(clock.lap());

  std::vector<Tensor> grads(kWantedCount);
  const auto want = [&](int which, const OptionalTensor& like) {
    grads[which] = make_tensor(wanted[which] && like.has_value() ? like->sizes() : at::IntArrayRef{0}, real);
    return data<S>(grads[which]);
  };
  sw::Gradients<S> out{};
  out.means = want(kWantMeans, in.means);
  out.opacities = want(kWantOpacities, in.opacities);
  out.scales = want(kWantScales, in.scales);
  out.quats = want(kWantQuats, in.quats);
  out.cov3d = want(kWantCov3d, in.cov3d);
  S* sh = want(kWantSh, in.sh);
  S* dc = want(kWantShDc, in.sh_dc);
  S* rest = want(kWantShRest, in.sh_rest);
  if (sh != nullptr) {
    out.sh_dc = sh, out.sh_dc_stride = out.sh_rest_stride = g.sh_dc_stride;
    if (in.sh->size(1) > 1) out.sh_rest = sh + 3;
  } else {
    out.sh_dc = dc, out.sh_dc_stride = 3;
    out.sh_rest = rest, out.sh_rest_stride = g.sh_rest_stride;
  }
  out.colors = want(kWantColors, in.colors);
  out.features = want(kWantFeatures, in.features);
  out.scale_factors = want(kWantScaleFactors, in.scale_factors);
  Tensor shape_sums;
  if (g.shape_rows != nullptr && (out.scales != nullptr || out.quats != nullptr)) {
    shape_sums = make_tensor({shape_groups(g.count, g.shapes), g.shapes, kShapeSums}, real);
    out.shape_sums = data<S>(shape_sums);
  }
  const OptionalTensor screen = at::empty({wanted[kWantGrad2d] || wanted[kWantAbsgrad2d] ? g.count : 0, 2}, real);
  out.grad2d = want(kWantGrad2d, screen);
  out.absgrad2d = want(kWantAbsgrad2d, screen);
  if (g.count > 0)
    SW_SELECT(project_backward<S>)(view, g, settings, channels, slots, data<S>(sums), out);
  else
    for (const int which : {kWantScales, kWantQuats}) grads[which].zero_();
  seconds.push_back(clock.lap());
  return {std::move(grads), std::move(seconds)};
}

std::tuple<std::vector<Tensor>, std::vector<double>> render_backward(
    const Tensor& means, const Tensor& opacities, const OptionalTensor& scales, const OptionalTensor& quats,
    const OptionalTensor& cov3d, const OptionalTensor& sh, const OptionalTensor& sh_dc, const OptionalTensor& sh_rest,
    const OptionalTensor& colors, const OptionalTensor& features, const OptionalTensor& scale_factors,
    const OptionalTensor& geom_indices, const OptionalTensor& visible, const OptionalTensor& background, at::ArrayRef<double> camera, int64_t width, int64_t height, int64_t sh_degree,
    double scale_modifier, double eps2d, int64_t flags, std::vector<Tensor> saved, const Tensor& image_gradient,
    const OptionalTensor& alpha_gradient, const OptionalTensor& median_gradient,
    std::array<bool, kWantedCount> wanted) {
  const Inputs in{means,    opacities, scales,     quats,     cov3d,          sh,    sh_dc, sh_rest, colors,
                  features, visible,   background, sh_degree, scale_modifier, eps2d, flags, 3,  scale_factors,
                  geom_indices};
  in.check();
  TORCH_CHECK(saved.size() == kSavedCount, "sw_rasterizers: the forward pass kept no state for the backward pass");
  return means.scalar_type() == at::kDouble ? backward_as<double>(in, camera, width, height, saved, image_gradient,
                                                                  alpha_gradient, median_gradient, wanted)
                                            : backward_as<float>(in, camera, width, height, saved, image_gradient,
                                                                 alpha_gradient, median_gradient, wanted);
}

template <class S>
void radii_as(const Inputs& in, at::ArrayRef<double> camera, int64_t width, int64_t height, Tensor& radii) {
  const auto view = sw::View<S>::from(camera.data(), int(width), int(height));
  if (in.means.size(0) > 0) SW_SELECT(visible_radii<S>)(view, in.gaussians<S>(), in.settings(), data<int32_t>(radii));
}

Tensor visible_radii(const Tensor& means, const OptionalTensor& scales, const OptionalTensor& quats,
                     const OptionalTensor& cov3d, const OptionalTensor& scale_factors,
                     const OptionalTensor& geom_indices, const OptionalTensor& visible, at::ArrayRef<double> camera,
                     int64_t width, int64_t height, double scale_modifier, double eps2d) {
  const OptionalTensor none, colors = means;
  const Tensor opacities = at::empty({0}, means.options());
  const Inputs in{means,  opacities, scales,  quats, cov3d, none,           none,  none,
                  colors, none,      visible, none,  0,     scale_modifier, eps2d, 0,
                  3,      scale_factors, geom_indices};
  in.check_geometry();
  Tensor radii = at::empty({means.size(0)}, means.options().dtype(at::kInt).requires_grad(false));
  means.scalar_type() == at::kDouble ? radii_as<double>(in, camera, width, height, radii)
                                     : radii_as<float>(in, camera, width, height, radii);
  return radii;
}

}  // namespace

TORCH_LIBRARY(sw_rasterizers, m) {
  m.def(
      "render(Tensor means, Tensor opacities, Tensor? scales, Tensor? quats, Tensor? cov3d, Tensor? sh, "
      "Tensor? sh_dc, Tensor? sh_rest, Tensor? colors, Tensor? features, Tensor? scale_factors, Tensor? geom_indices, "
      "Tensor? visible, Tensor? background, "
      "float[] camera, int width, int height, int sh_degree, float scale_modifier, float eps2d, int flags) "
      "-> (Tensor image, Tensor radii, Tensor alpha, Tensor median, Tensor[] saved, int[] counts, float[] seconds)");
  m.def(
      "render_backward(Tensor means, Tensor opacities, Tensor? scales, Tensor? quats, Tensor? cov3d, Tensor? sh, "
      "Tensor? sh_dc, Tensor? sh_rest, Tensor? colors, Tensor? features, Tensor? scale_factors, Tensor? geom_indices, "
      "Tensor? visible, Tensor? background, "
      "float[] camera, int width, int height, int sh_degree, float scale_modifier, float eps2d, int flags, "
      "Tensor[] saved, Tensor image_gradient, Tensor? alpha_gradient, Tensor? median_gradient, bool[13] wanted) "
      "-> (Tensor[] gradients, float[] seconds)");
  m.def(
      "visible_radii(Tensor means, Tensor? scales, Tensor? quats, Tensor? cov3d, Tensor? scale_factors, Tensor? geom_indices, "
      "Tensor? visible, float[] camera, int width, int height, float scale_modifier, float eps2d) -> Tensor");
}

TORCH_LIBRARY_IMPL(sw_rasterizers, CPU, m) {
  m.impl("render", render);
  m.impl("render_backward", render_backward);
  m.impl("visible_radii", visible_radii);
}
