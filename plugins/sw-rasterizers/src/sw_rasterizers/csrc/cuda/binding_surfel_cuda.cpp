// The ops torch.ops.sw_rasterizers.*surfel* on CUDA; the work is done in cuda/surfel_*.cu. Compiled only where there is
// CUDA.
#ifdef SW_WITH_CUDA

#include <ATen/ops/empty.h>
#include <ATen/ops/zeros.h>
#include <torch/library.h>

#include <tuple>
#include <vector>

#include "binding_cuda.h"
#include "binding_surfel.h"
#include "surfel_kernels.h"

namespace {

using namespace sw;        // NOLINT: one file
using namespace sw::cuda;  // NOLINT

// clang-format off
enum Saved {  // the state that the backward pass needs
  kShape, kPlanes, kTileStart, kSplat, kFlags, kTransmittance, kLast, kFirst, kSum, kSquare, kMedian, kSavedCount
};
// clang-format on

SurfelImage image_of(const Inputs& in, const std::vector<Tensor>& saved) {
  SurfelImage target{};
  target.image.channels = target.image.color_channels = 3;
  target.image.background = data<float>(in.background);
  target.image.background_is_image = in.background.has_value() && in.background->dim() == 3;
  target.image.transmittance = data<float>(saved[kTransmittance]);
  target.image.last = data<int32_t>(saved[kLast]);
  target.pixels = {data<float>(saved[kFirst]), data<float>(saved[kSum]), data<float>(saved[kSquare]),
                   data<int32_t>(saved[kMedian])};
  return target;
}

std::tuple<Tensor, Tensor, Tensor, Tensor, std::vector<Tensor>, std::vector<int64_t>, std::vector<double>> render(
    const Tensor& means, const Tensor& opacities, const OptionalTensor& scales, const OptionalTensor& quats,
    const OptionalTensor& sh, const OptionalTensor& sh_dc, const OptionalTensor& sh_rest, const OptionalTensor& colors,
    const OptionalTensor& visible, const OptionalTensor& background, at::ArrayRef<double> camera, int64_t width,
    int64_t height, int64_t sh_degree, double scale_modifier, int64_t flags) {
  const SurfelInputs in(means, opacities, scales, quats, sh, sh_dc, sh_rest, colors, visible, background, sh_degree,
                        scale_modifier, flags);
  in.check_all(camera, width, height);
  check_placement(in);
  const c10::cuda::CUDAGuard guard(means.device());
  const cudaStream_t stream = c10::cuda::getCurrentCUDAStream();
  const auto view = View<float>::from(camera.data(), int(width), int(height));
  const auto g = in.gaussians<float>();
  const auto settings = in.settings();
  const bool save = flags & kSave, with_maps = flags & kWithMaps, count_work = flags & kCount;
  const int64_t n = g.count;
  const auto real = means.options().requires_grad(false);
  const auto make = [&](at::IntArrayRef shape) { return at::empty(shape, real); };
  const auto make_as = [&](at::IntArrayRef shape, at::ScalarType type) { return at::empty(shape, real.dtype(type)); };
  StageClock clock{count_work, stream, {}};
  clock.mark();

  Tally tally(n, real, stream);
  Projected projected(n, kPlane, settings.tight, real);
  Tensor radii = make_as({n}, at::kInt), drawn = make_as({save ? n : 0}, at::kByte);
  if (n > 0) {
    project_surfels(view, g, settings, projected.splats, projected.work, data<int32_t>(radii), data<uint8_t>(drawn),
                    tally.counters, tally.states, tally.published, stream);
    tally.projected();
    shade(view, g, settings, projected.splats, data<int32_t>(radii), data<uint8_t>(drawn), tally.counters,
          tally.published, stream);
    tally.shaded(settings);
  }
  clock.mark();

  std::vector<Tensor> saved(kSavedCount);
  const Binned binned(view, settings, projected, tally, kPlane, save, clock);
  saved[kShape] = binned.compact.shape, saved[kPlanes] = binned.compact.channels;
  saved[kTileStart] = binned.tile_start, saved[kSplat] = binned.splat, saved[kFlags] = drawn;
  clock.mark();

  const int64_t rows = save ? height : 0, map_rows = save && with_maps ? height : 0;
  saved[kTransmittance] = make({rows, width}), saved[kLast] = make_as({rows, width}, at::kInt);
  for (const int field : {kFirst, kSum, kSquare}) saved[size_t(field)] = make({map_rows, width});
  saved[kMedian] = make_as({map_rows, width}, at::kInt);
  Tensor image = make({3, height, width}), alpha = make({(flags & kAlphaMap) ? 1 : 0, height, width});
  Tensor maps = make({with_maps ? kMaps : 0, height, width});
  SurfelImage target = image_of(in, saved);
  target.image.image = data<float>(image), target.image.alpha = data<float>(alpha);
  target.maps = data<float>(maps);
  blend_surfels(view, settings.tight, binned.drawn, binned.lists(), target, count_work ? tally.counters : nullptr,
                stream);
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  clock.mark();

  std::vector<int64_t> counts = tally.counts(count_work);
  if (save) {
    for (Tensor& t : saved)
      if (!t.defined()) t = make({0});
  } else {
    saved.clear();
  }
  return {image, radii, alpha, maps, std::move(saved), std::move(counts), clock.seconds()};
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
  check_placement(in);
  TORCH_CHECK(saved.size() == kSavedCount, "sw_rasterizers: the forward pass kept no state for the backward pass");
  in.check_shape("image_gradient", image_gradient, {3, height, width});
  in.check_shape("alpha_gradient", alpha_gradient, {1, height, width});
  in.check_shape("maps_gradient", maps_gradient, {kMaps, height, width});
  TORCH_CHECK(!maps_gradient.has_value() || (flags & kWithMaps), "sw_rasterizers: no maps were drawn");
  const c10::cuda::CUDAGuard guard(means.device());
  const cudaStream_t stream = c10::cuda::getCurrentCUDAStream();
  const auto view = View<float>::from(camera.data(), int(width), int(height));
  const auto g = in.gaussians<float>();
  const auto settings = in.settings();
  const auto real = means.options().requires_grad(false);
  const bool maps = maps_gradient.has_value();
  StageClock clock{(flags & kCount) != 0, stream, {}};
  clock.mark();

  const Tensor sums = at::zeros({g.count, surfel_columns(maps)}, real);
  const Splats splats = splats_of(saved[kShape], saved[kPlanes]);
  const TileLists lists{data<int32_t>(saved[kTileStart]), data<int32_t>(saved[kSplat])};
  const ImageGradient gradient{data<float>(image_gradient), data<float>(alpha_gradient), nullptr};
  Ordered ordered{};
  Tensor pair_sums;
  Grouped pairs_of_splat;
  const int64_t pairs = saved[kSplat].numel();
  if ((flags & kOrdered) && pairs > 0) {
    ordered.pairs = pairs, ordered.splats = saved[kShape].size(0);
    pair_sums = at::empty({pairs, surfel_columns(maps)}, real);
    pairs_of_splat = Grouped(saved[kSplat], ordered.splats, stream);
    ordered.pair_sums = data<float>(pair_sums), ordered.pairs_of_splat = pairs_of_splat.groups();
  }
  if (pairs > 0)
    blend_surfels_backward(view, settings, splats, lists, image_of(in, saved), gradient, data<float>(maps_gradient),
                           data<float>(sums), ordered, stream);
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  clock.mark();

  SurfelGradients found(in, wanted, [&](at::IntArrayRef shape) { return at::empty(shape, real); });
  if (g.count > 0)
    project_surfels_backward(view, g, settings, data<uint8_t>(saved[kFlags]), data<float>(sums), maps,
                             found.pointers<float>(), stream);
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  clock.mark();
  return {std::move(found.tensors), clock.seconds()};
}

Tensor surfel_radii(const Tensor& means, const OptionalTensor& scales, const OptionalTensor& quats,
                     const OptionalTensor& visible, at::ArrayRef<double> camera, int64_t width, int64_t height) {
  const OptionalTensor colors = means;
  const Tensor opacities = at::empty({0}, means.options());
  const SurfelInputs in(means, opacities, scales, quats, kNone, kNone, kNone, colors, visible, kNone, 0, 1, 0);
  in.check_geometry();
  check_placement(in);
  TORCH_CHECK(camera.size() == 18 && width > 0 && height > 0, "sw_rasterizers: malformed camera");
  const c10::cuda::CUDAGuard guard(means.device());
  Tensor radii = at::empty({means.size(0)}, means.options().dtype(at::kInt).requires_grad(false));
  const auto view = View<float>::from(camera.data(), int(width), int(height));
  if (means.size(0) > 0)
    visible_surfel_radii(view, in.gaussians<float>(), in.settings(), data<int32_t>(radii),
                         c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
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

TORCH_LIBRARY_IMPL(sw_rasterizers, CUDA, m) {
  m.impl("render_surfels", render);
  m.impl("render_surfels_backward", render_backward);
  m.impl("visible_surfel_radii", surfel_radii);
}

#endif  // SW_WITH_CUDA
