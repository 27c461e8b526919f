// The ops torch.ops.sw_rasterizers.* on CUDA: memory from torch's allocator, launches on the current stream; the work
// is done in cuda/. Compiled only where there is CUDA.
#ifdef SW_WITH_CUDA

#include <ATen/ops/zeros.h>
#include <torch/library.h>

#include <tuple>
#include <vector>

#include "binding_cuda.h"
#include "binding_state.h"

namespace {

using namespace sw;        // NOLINT: one file
using namespace sw::cuda;  // NOLINT

Image image_of(const Inputs& in) {
  Image image{};
  image.channels = in.channels().total(), image.color_channels = in.channels().colors;
  image.background = data<float>(in.background);
  image.background_is_image = in.background.has_value() && in.background->dim() == 3;
  return image;
}

}  // namespace

sw::cuda::Rendered sw::cuda::render_on_cuda(const Inputs& in, at::ArrayRef<double> camera, int64_t width,
                                            int64_t height) {
  const c10::cuda::CUDAGuard guard(in.means.device());
  const cudaStream_t stream = c10::cuda::getCurrentCUDAStream();
  const auto view = View<float>::from(camera.data(), int(width), int(height));
  const auto g = in.gaussians<float>();
  const auto settings = in.settings();
  const auto channels = in.channels();
  const bool save = in.flags & kSave, general = !in.plain(), count_work = in.flags & kCount;
  const int64_t n = g.count, total = channels.total();
  const auto real = in.means.options().requires_grad(false);
  const auto make = [&](at::IntArrayRef shape) { return at::empty(shape, real); };
  const auto make_as = [&](at::IntArrayRef shape, at::ScalarType type) { return at::empty(shape, real.dtype(type)); };
  StageClock clock{count_work, stream, {}};
  clock.mark();

  Tally tally(n, real, stream);

  const int row = general ? int(total) : 0;
  Projected projected(n, row, settings.tight, real);
  const Splats& splats = projected.splats;
  const SplatWork& work = projected.work;
  Tensor radii = make_as({n}, at::kInt), flags = make_as({save ? n : 0}, at::kByte);
  if (n > 0) {
    project(view, g, settings, splats, work, data<int32_t>(radii), data<uint8_t>(flags), tally.counters, tally.states,
            tally.published, stream);
    tally.projected();
    if (g.colors == nullptr || g.color_channels == 3)
      shade(view, g, settings, splats, data<int32_t>(radii), data<uint8_t>(flags), tally.counters,
            tally.published, stream);
    if (general)
      fill_channels(g, channels, splats, work, data<int32_t>(radii), data<uint8_t>(flags), tally.counters,
            tally.published, stream);
    tally.shaded(settings);
  }
  clock.mark();

  std::vector<Tensor> saved(kSavedCount);
  const bool median = settings.median_depth;
  const Binned binned(view, settings, projected, tally, row, save || median, clock);
  saved[kShape] = binned.compact.shape, saved[kChannelRows] = binned.compact.channels;
  saved[kTileStart] = binned.tile_start, saved[kSplat] = binned.splat;
  clock.mark();

  if (save) saved[kTransmittance] = make({height, width}), saved[kLast] = make_as({height, width}, at::kInt);
  if (save && median) saved[kMedianSplat] = make_as({height, width}, at::kInt);
  const bool fast = in.flags & (kFlash | kTensorCores), as_bytes = in.flags & kBytes;
  TORCH_CHECK(fast || !as_bytes, "sw_rasterizers: 8-bit images are drawn by the inference kernels only");
  TORCH_CHECK(!fast || (!general && !save), "sw_rasterizers: the inference kernels draw three colours, no gradients");
  Tensor picture = as_bytes ? make_as({total, height, width}, at::kByte) : make({total, height, width});
  Tensor alpha = make({(in.flags & kAlphaMap) ? 1 : 0, height, width});
  Tensor median_depth = make({median ? 1 : 0, height, width});
  Image image = image_of(in);
  image.image = as_bytes ? nullptr : data<float>(picture);
  image.alpha = data<float>(alpha), image.median = data<float>(median_depth);
  image.transmittance = data<float>(saved[kTransmittance]), image.last = data<int32_t>(saved[kLast]);
  image.median_splat = data<int32_t>(saved[kMedianSplat]);
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const bool few = !fast && !general && !count_work && tiles < kFewTiles;
  const bool cut = few && save && !(in.flags & kForScores) && tally.pairs() > 0;
  const bool split = few && tiles < kSplitTiles && tally.pairs() > 0;
  Tensor behind, scratch;
  if (cut || split) {
    const int64_t pieces = piece_count(tiles, tally.pairs());
    behind = make({pieces, kTile * kTile, 4});
    if (split) scratch = make_as({int64_t(few_scratch(tiles, pieces))}, at::kByte);
    if (cut) saved[kBehind] = behind, saved[kWhere] = make_as({pieces, 2}, at::kInt);
    image.pieces = {data<float4>(behind), data<int2>(saved[kWhere]), pieces};
  }
  if (fast)
    (in.flags & kFlash ? blend_flash : blend_tcgs)(view, binned.drawn, binned.lists(), image,
                                                   as_bytes ? data<uint8_t>(picture) : nullptr, stream);
  else if (few)
    blend_few(split ? scratch.data_ptr() : nullptr, view, binned.drawn, binned.lists(), image, stream);
  else
    blend(view, binned.drawn, binned.lists(), image, general, count_work ? tally.counters : nullptr,
          binned.sorted_depth, stream);
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  clock.mark();

  std::vector<int64_t> counts = tally.counts(count_work);
  if (save) {
    const Tensor nothing = make({0});
    for (Tensor& t : saved)
      if (!t.defined()) t = nothing;
    saved.push_back(flags);
  } else {
    saved.clear();
  }
  return {picture, radii, alpha, median_depth, std::move(saved), std::move(counts), clock.seconds()};
}

namespace {

Rendered render(const Tensor& means, const Tensor& opacities, const OptionalTensor& scales,
                const OptionalTensor& quats, const OptionalTensor& cov3d, const OptionalTensor& sh,
                const OptionalTensor& sh_dc, const OptionalTensor& sh_rest, const OptionalTensor& colors,
                const OptionalTensor& features, const OptionalTensor& scale_factors,
                const OptionalTensor& geom_indices, const OptionalTensor& visible, const OptionalTensor& background,
                at::ArrayRef<double> camera, int64_t width, int64_t height, int64_t sh_degree, double scale_modifier,
                double eps2d, int64_t flags) {
  const Inputs in{means,    opacities, scales,     quats,     cov3d,          sh,    sh_dc, sh_rest, colors,
                  features, visible,   background, sh_degree, scale_modifier, eps2d, flags, 3,  scale_factors,
                  geom_indices};
  in.check();
  check_placement(in);
  TORCH_CHECK(camera.size() == 18 && width > 0 && height > 0, "sw_rasterizers: malformed camera");
  return render_on_cuda(in, camera, width, height);
}

}  // namespace

// Gradients in two nodes, so that what the first one needs, the image's gradient and the lists, is free again before
// the second one allocates the gradients of the inputs, which are larger than all else.
//
// Returns rows [N, row_length], sums of every Gaussian, zeros where it was not drawn.
Tensor sw::cuda::blend_backward_on_cuda(const DrawCall& call, const std::vector<Tensor>& saved,
                                        const Tensor& image_gradient, const OptionalTensor& alpha_gradient,
                                        const OptionalTensor& median_gradient, std::vector<double>& seconds) {
  TORCH_CHECK(saved.size() == kSavedCount, "sw_rasterizers: the forward pass kept no state for the backward pass");
  const int64_t flags = call.flags, width = call.width, height = call.height, gaussians = call.gaussians;
  const Channels channels = call.channels;
  for (const OptionalTensor* t : {&alpha_gradient, &median_gradient})
    TORCH_CHECK(!t->has_value() || ((*t)->is_contiguous() && (*t)->device() == image_gradient.device()),
                "sw_rasterizers: gradients must be contiguous and on one device");
  TORCH_CHECK(image_gradient.is_contiguous() && image_gradient.scalar_type() == at::kFloat &&
                  image_gradient.sizes() == at::IntArrayRef({channels.total(), height, width}),
              "sw_rasterizers: the image's gradient must be contiguous float32 of shape [", channels.total(), ", ",
              height, ", ", width, "], got ", image_gradient.sizes());
  const c10::cuda::CUDAGuard guard(image_gradient.device());
  const cudaStream_t stream = c10::cuda::getCurrentCUDAStream();
  const auto view = View<float>::from(call.camera.data(), int(width), int(height));
  StageClock clock{(flags & kCount) != 0, stream, {}};
  clock.mark();

  const bool absgrad = flags & kAbsgrad, median = flags & kMedianDepth;
  const int length = row_length(channels.total(), absgrad, median);
  const Tensor row_memory = at::empty({gaussians, length}, image_gradient.options().requires_grad(false));
  C10_CUDA_CHECK(cudaMemsetAsync(row_memory.data_ptr(), 0, row_memory.nbytes(), stream));
  const Rows rows{data<float>(row_memory), length, channels.total(), absgrad, median, (flags & kFragments) != 0};
  Image image{};
  image.channels = channels.total(), image.color_channels = channels.colors;
  image.background = data<float>(call.background);
  image.background_is_image = call.background.has_value() && call.background->dim() == 3;
  image.transmittance = data<float>(saved[kTransmittance]), image.last = data<int32_t>(saved[kLast]);
  image.median_splat = data<int32_t>(saved[kMedianSplat]);
  image.pieces = {data<float4>(saved[kBehind]), data<int2>(saved[kWhere]), saved[kWhere].size(0)};
  const ImageGradient gradient{data<float>(image_gradient), data<float>(alpha_gradient), data<float>(median_gradient)};
  const Splats splats = splats_of(saved[kShape], saved[kChannelRows]);
  const bool general = channels.total() != 3 || channels.colors != 3 || median;
  Ordered ordered{};
  Tensor pair_sums;
  Grouped pairs_of_splat, pixels_of_gaussian;
  const int64_t pairs = saved[kSplat].numel();
  if ((flags & kOrdered) && pairs > 0) {
    ordered.pairs = pairs, ordered.splats = saved[kShape].size(0), ordered.gaussians = gaussians;
    pair_sums = at::empty({pairs, pair_row_length(general, absgrad)}, row_memory.options());
    ordered.pair_sums = data<float>(pair_sums);
    pairs_of_splat = Grouped(saved[kSplat], ordered.splats, stream);
    ordered.pairs_of_splat = pairs_of_splat.groups();
    if (gradient.median != nullptr) {
      pixels_of_gaussian = Grouped(saved[kMedianSplat], gaussians, stream);
      ordered.pixels_of_gaussian = pixels_of_gaussian.groups();
    }
  }
  if (pairs > 0)
    blend_backward(view, flags & kPassClamp, splats, {data<int32_t>(saved[kTileStart]), data<int32_t>(saved[kSplat])},
                   image, general, gradient, flags & kDetachFeatures ? channels.features : 0, rows, ordered, stream);
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  clock.mark();
  seconds = clock.seconds();
  return row_memory;
}

// Returns the gradients in the order of Wanted, undefined where none is wanted; those by the projected centres go into
// the tensors of `call`, whose updates are done.
std::vector<Tensor> sw::cuda::project_backward_on_cuda(const Inputs& in, const DrawCall& call, const Tensor& drawn,
                                                       const Tensor& row_memory, std::array<bool, kWantedCount> wanted,
                                                       std::vector<double>& seconds) {
  in.check();
  check_placement(in);
  const Tensor& means = in.means;
  const auto channels = in.channels();
  const int64_t flags = call.flags, n = means.size(0);
  const bool absgrad = flags & kAbsgrad, median = flags & kMedianDepth;
  const int length = row_length(channels.total(), absgrad, median);
  in.check_shape("rows", row_memory, {n, length});
  in.check_shape("drawn", drawn, {n});
  const c10::cuda::CUDAGuard guard(means.device());
  const cudaStream_t stream = c10::cuda::getCurrentCUDAStream();
  const auto view = View<float>::from(call.camera.data(), int(call.width), int(call.height));
  const auto g = in.gaussians<float>();
  const auto real = means.options().requires_grad(false);
  StageClock clock{(flags & kCount) != 0, stream, {}};
  clock.mark();

  // An update whose gradient is not asked for keeps waiting; one that is done here leaves none.
  ShAdam adam{};
  const std::vector<Tensor>& updated = call.updated;
  for (size_t i = 0; i < updated.size(); i += 3) {
    const OptionalTensor& like = i == 0 ? in.sh_dc : in.sh_rest;
    bool& asked = wanted[i == 0 ? kWantShDc : kWantShRest];
    if (!asked || updated[i].numel() == 0) continue;
    asked = false;
    TORCH_CHECK(like.has_value() && updated[i].data_ptr() == like->data_ptr(),
                "sw_rasterizers: Adam in the backward pass is of the tensors that were drawn");
    for (size_t k = i; k < i + 3; ++k)
      TORCH_CHECK(updated[k].is_contiguous() && updated[k].sizes() == like->sizes() &&
                      updated[k].scalar_type() == at::kFloat && updated[k].device() == means.device() &&
                      reinterpret_cast<uintptr_t>(updated[k].data_ptr()) % 16 == 0,
                  "sw_rasterizers: parameter and moments must be contiguous float32 of shape ", like->sizes());
    const double* r = call.rates.data() + 2 * i;
    RowAdam& of = i == 0 ? adam.dc : adam.rest;
    of = RowAdam{data<float>(updated[i]), data<float>(updated[i + 1]), data<float>(updated[i + 2]),
                 float(r[0]), float(r[1]), float(r[2]), float(r[3]), float(r[4]), float(r[5])};
  }
  std::vector<Tensor> grads(kWantedCount);
  const bool shared = in.geom_indices.has_value();  // then the rows of shapes are summed up, starting at 0
  const auto want = [&](int which, const OptionalTensor& like) {
    if (wanted[which] && like.has_value())
      grads[which] = shared && (which == kWantScales || which == kWantQuats) ? at::zeros(like->sizes(), real)
                                                                             : at::empty(like->sizes(), real);
    return data<float>(grads[which]);
  };
  Gradients<float> out{};
  out.means = want(kWantMeans, in.means);
  out.opacities = want(kWantOpacities, in.opacities);
  out.scales = want(kWantScales, in.scales);
  out.quats = want(kWantQuats, in.quats);
  out.cov3d = want(kWantCov3d, in.cov3d);
  float* dense = want(kWantSh, in.sh);
  float* dc = want(kWantShDc, in.sh_dc);
  float* rest = want(kWantShRest, in.sh_rest);
  if (dense != nullptr) {
    out.sh_dc = dense, out.sh_dc_stride = out.sh_rest_stride = g.sh_dc_stride;
    if (in.sh->size(1) > 1) out.sh_rest = dense + 3;
  } else {
    out.sh_dc = dc, out.sh_dc_stride = 3;
    out.sh_rest = rest, out.sh_rest_stride = g.sh_rest_stride;
  }
  out.colors = want(kWantColors, in.colors);
  out.features = want(kWantFeatures, in.features);
  out.scale_factors = want(kWantScaleFactors, in.scale_factors);
  const auto screen = [&](const Tensor& late) { return late.defined() ? data<float>(late.resize_({n, 2})) : nullptr; };
  out.grad2d = screen(call.grad2d);
  out.absgrad2d = screen(call.absgrad2d);
  const Rows rows{data<float>(row_memory), length, channels.total(), absgrad, median, (flags & kFragments) != 0};
  if (n > 0) project_backward(view, g, in.settings(), channels, data<uint8_t>(drawn), rows, out, adam, stream);
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  // Whoever offered an update sees by the version that it is done.
  if (adam.dc.param != nullptr) updated[0].unsafeGetTensorImpl()->bump_version();
  if (adam.rest.param != nullptr) updated[3].unsafeGetTensorImpl()->bump_version();
  clock.mark();
  seconds = clock.seconds();
  return grads;
}

namespace {

Tensor visible_radii_on_cuda(const Tensor& means, const OptionalTensor& scales, const OptionalTensor& quats,
                             const OptionalTensor& cov3d, const OptionalTensor& scale_factors,
                             const OptionalTensor& geom_indices, const OptionalTensor& visible,
                             at::ArrayRef<double> camera,
                             int64_t width, int64_t height, double scale_modifier, double eps2d) {
  const OptionalTensor none, colors = means;
  const Tensor opacities = at::empty({0}, means.options());
  const Inputs in{means,  opacities, scales,  quats, cov3d, none,           none,  none,
                  colors, none,      visible, none,  0,     scale_modifier, eps2d, 0,
                  3,      scale_factors, geom_indices};
  in.check_geometry();
  check_placement(in);
  const c10::cuda::CUDAGuard guard(means.device());
  Tensor radii = at::empty({means.size(0)}, means.options().dtype(at::kInt).requires_grad(false));
  const auto view = View<float>::from(camera.data(), int(width), int(height));
  if (means.size(0) > 0)
    sw::cuda::visible_radii(view, in.gaussians<float>(), in.settings(), data<int32_t>(radii),
                            c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
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
      "visible_radii(Tensor means, Tensor? scales, Tensor? quats, Tensor? cov3d, Tensor? scale_factors, Tensor? geom_indices, "
      "Tensor? visible, float[] camera, int width, int height, float scale_modifier, float eps2d) -> Tensor");
}

TORCH_LIBRARY_IMPL(sw_rasterizers, CUDA, m) {
  m.impl("render", render);
  m.impl("visible_radii", visible_radii_on_cuda);
}

#endif  // SW_WITH_CUDA
