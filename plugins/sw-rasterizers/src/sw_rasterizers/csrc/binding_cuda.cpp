// The ops torch.ops.sw_rasterizers.* on CUDA: memory from torch's allocator, launches on the current stream; the work
// is done in cuda/. Compiled only where there is CUDA.
#ifdef SW_WITH_CUDA

#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/zeros.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>
#include <torch/library.h>

#include <algorithm>
#include <bit>
#include <tuple>
#include <utility>
#include <vector>

#include "binding.h"
#include "cuda/kernels.h"

namespace {

using namespace sw;        // NOLINT: one file
using namespace sw::cuda;  // NOLINT

// The state that blend_backward needs; the flags of the Gaussians, for project_backward, come behind it.
enum Saved { kShape, kTail, kChannelRows, kTileStart, kSplat, kTransmittance, kLast, kMedianSplat, kSavedCount };

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

void check_placement(const Inputs& in) {
  TORCH_CHECK(in.means.scalar_type() == at::kFloat, "sw_rasterizers: on CUDA means must be float32, got ",
              in.means.scalar_type());
  TORCH_CHECK(!in.background.has_value() || in.background->device() == in.means.device(),
              "sw_rasterizers: background is on ", in.background->device(), ", means on ", in.means.device());
  TORCH_CHECK(!in.quats.has_value() || reinterpret_cast<uintptr_t>(in.quats->data_ptr()) % 16 == 0,
              "sw_rasterizers: on CUDA quats must start at a multiple of 16 bytes; clone() it");
}

Splats splats_of(const Tensor& shape, const Tensor& tail, const Tensor& channels) {
  return {data<float4>(shape), data<float2>(tail), data<float>(channels)};
}

Image image_of(const Inputs& in) {
  Image image{};
  image.channels = in.channels().total(), image.color_channels = in.channels().colors;
  image.background = data<float>(in.background);
  image.background_is_image = in.background.has_value() && in.background->dim() == 3;
  return image;
}

using Rendered = std::tuple<Tensor, Tensor, Tensor, Tensor, std::vector<Tensor>, std::vector<int64_t>,
                            std::vector<double>>;

Rendered render_on_cuda(const Inputs& in, at::ArrayRef<double> camera, int64_t width, int64_t height) {
  const c10::cuda::CUDAGuard guard(in.means.device());
  const cudaStream_t stream = c10::cuda::getCurrentCUDAStream();
  const auto view = View<float>::from(camera.data(), int(width), int(height));
  const auto g = in.gaussians<float>();
  const auto settings = in.settings();
  const auto channels = in.channels();
  const bool save = in.flags & kSave, general = !in.plain(), count_work = in.flags & kCount;
  const int64_t n = g.count, total = channels.total(), tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const bool wide = tiles >= 0xffff;  // one key more than tiles: for places that no tile claims
  const auto real = in.means.options().requires_grad(false);
  const auto make = [&](at::IntArrayRef shape) { return at::empty(shape, real); };
  const auto make_as = [&](at::IntArrayRef shape, at::ScalarType type) { return at::empty(shape, real.dtype(type)); };
  const auto bytes = [&](size_t count) { return make_as({int64_t(count)}, at::kByte); };
  StageClock clock{count_work, stream, {}};
  clock.mark();

  const int64_t project_blocks = (n + kProjectThreads - 1) / kProjectThreads;
  const size_t counter_bytes = sizeof(Counters) + 2 * size_t(project_blocks + 1) * sizeof(uint64_t);
  const Tensor counter_memory = bytes(counter_bytes);
  auto* counters = reinterpret_cast<Counters*>(counter_memory.data_ptr());
  auto* states = reinterpret_cast<uint64_t*>(counters + 1);
  C10_CUDA_CHECK(cudaMemsetAsync(counters, 0, counter_bytes, stream));
  const Tensor pinned = at::empty({16}, at::TensorOptions().dtype(at::kLong).pinned_memory(true));
  auto* published = reinterpret_cast<Published*>(pinned.data_ptr());
  auto* after = reinterpret_cast<Counters*>(published + 1);
  *published = {};
  *after = {};

  // Compact, but for up to N splats: how many there are is not known yet.
  Tensor shape = make({n, 8}), tail = make({n, 2}), channel_rows = make({general ? n : 0, total});
  Tensor depth = make_as({n}, at::kInt), order = make_as({n}, at::kInt);
  Tensor extent = make({n, 2}), tile_counts = make_as({n}, at::kInt), radius = make_as({settings.tight ? 0 : n}, at::kInt);
  Tensor radii = make_as({n}, at::kInt), flags = make_as({save ? n : 0}, at::kByte);
  Splats splats = splats_of(shape, tail, channel_rows);
  const SplatWork work{data<uint32_t>(depth), data<float2>(extent), data<int32_t>(radius), data<int32_t>(tile_counts),
                       data<int32_t>(order)};
  Event counted(false), colored(false);
  if (n > 0) {
    project(view, g, settings, splats, work, data<int32_t>(radii), data<uint8_t>(flags), counters, states, published,
            stream);
    counted.record(stream);
    if (g.colors == nullptr || g.color_channels == 3)
      shade(view, g, settings, splats, data<int32_t>(radii), data<uint8_t>(flags), counters, stream);
    if (general)
      fill_channels(g, channels, splats, work, data<int32_t>(radii), data<uint8_t>(flags), counters, stream);
    C10_CUDA_CHECK(cudaMemcpyAsync(after, counters, sizeof(Counters), cudaMemcpyDeviceToHost, stream));
    colored.record(stream);
    C10_CUDA_KERNEL_LAUNCH_CHECK();
    counted.wait();  // the colours are still being computed
  }
  const int64_t used = published->splats, count = published->pairs;
  TORCH_CHECK(count <= std::numeric_limits<int32_t>::max(), "sw_rasterizers: ", count,
              " splat-tile pairs are more than 2^31 - 1; render fewer Gaussians or a smaller image");
  clock.mark();

  int32_t* sorted = nullptr;
  Tensor depth_other, order_other;
  uint32_t* sorted_depth = nullptr;
  if (used > 0) {
    depth_other = make_as({used}, at::kInt), order_other = make_as({used}, at::kInt);
    const auto run = [&](void* scratch, size_t size) {
      return depth_order(scratch, size, int(used), data<uint32_t>(depth), data<uint32_t>(depth_other),
                         data<int32_t>(order), data<int32_t>(order_other), &sorted, &sorted_depth, stream);
    };
    const size_t size = run(nullptr, 0);
    const Tensor scratch = bytes(std::max<size_t>(size, 1));
    run(scratch.data_ptr(), size);
  }
  clock.mark();

  std::vector<Tensor> saved(kSavedCount);
  saved[kTileStart] = make_as({tiles + 1}, at::kInt);
  const bool median = settings.median_depth, compact = save || median;
  Tensor keys[2], values[2];
  void* sorted_keys = nullptr;
  int32_t* sorted_values = nullptr;
  Splats drawn = splats;
  if (count > 0) {
    for (Tensor& t : keys) t = make_as({count}, wide ? at::kInt : at::kShort);
    for (Tensor& t : values) t = make_as({count}, at::kInt);
    if (compact) {
      saved[kShape] = make({used, 8}), saved[kTail] = make({used, 2});
      saved[kChannelRows] = make({general ? used : 0, total});
      drawn = splats_of(saved[kShape], saved[kTail], saved[kChannelRows]);
    }
    emit(view, settings, int(used), sorted, splats, work, compact ? &drawn : nullptr, general ? int(total) : 0,
         keys[0].data_ptr(), wide, data<int32_t>(values[0]), counters, states + project_blocks + 1, stream);
    const int key_bits = std::bit_width(uint64_t(tiles));
    const auto run = [&](void* scratch, size_t size) {
      return sort_pairs(scratch, size, int(count), key_bits, wide, keys[0].data_ptr(), keys[1].data_ptr(),
                        data<int32_t>(values[0]), data<int32_t>(values[1]), &sorted_keys, &sorted_values, stream);
    };
    const size_t size = run(nullptr, 0);
    const Tensor scratch = bytes(std::max<size_t>(size, 1));
    run(scratch.data_ptr(), size);
  }
  find_tiles(int(count), int(tiles), sorted_keys, wide, data<int32_t>(saved[kTileStart]), stream);
  if (count > 0) saved[kSplat] = sorted_values == data<int32_t>(values[0]) ? values[0] : values[1];
  for (Tensor& t : keys) t.reset();
  for (Tensor& t : values) t.reset();
  clock.mark();

  saved[kTransmittance] = make({save ? height : 0, width});
  saved[kLast] = make_as({save ? height : 0, width}, at::kInt);
  saved[kMedianSplat] = make_as({save && median ? height : 0, width}, at::kInt);
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
  const TileLists lists{data<int32_t>(saved[kTileStart]), data<int32_t>(saved[kSplat])};
  if (fast)
    (in.flags & kFlash ? blend_flash : blend_tcgs)(view, drawn, lists, image,
                                                   as_bytes ? data<uint8_t>(picture) : nullptr, stream);
  else
    blend(view, drawn, lists, image, general, count_work ? counters : nullptr, sorted_depth, stream);
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  clock.mark();

  if (n > 0) colored.wait();  // long past by now
  int64_t evaluated = -1, blended = -1;
  if (count_work && !fast) {
    Counters now{};
    C10_CUDA_CHECK(cudaMemcpyAsync(&now, counters, sizeof now, cudaMemcpyDeviceToHost, stream));
    C10_CUDA_CHECK(cudaStreamSynchronize(stream));
    evaluated = int64_t(now.evaluated), blended = int64_t(now.blended);
  }
  const int64_t bad = after->bad_colors;
  std::vector<int64_t> counts = {published->visible - bad, count, evaluated, blended, published->invalid + bad};
  if (save) {
    for (Tensor& t : saved)
      if (!t.defined()) t = make({0});
    saved.push_back(flags);
  } else {
    saved.clear();
  }
  return {picture, radii, alpha, median_depth, std::move(saved), std::move(counts), clock.seconds()};
}

Rendered render(const Tensor& means, const Tensor& opacities, const OptionalTensor& scales,
                const OptionalTensor& quats, const OptionalTensor& cov3d, const OptionalTensor& sh,
                const OptionalTensor& sh_dc, const OptionalTensor& sh_rest, const OptionalTensor& colors,
                const OptionalTensor& features, const OptionalTensor& visible, const OptionalTensor& background,
                at::ArrayRef<double> camera, int64_t width, int64_t height, int64_t sh_degree, double scale_modifier,
                double eps2d, int64_t flags) {
  const Inputs in{means,    opacities, scales,     quats,     cov3d,          sh,    sh_dc, sh_rest, colors,
                  features, visible,   background, sh_degree, scale_modifier, eps2d, flags};
  in.check();
  check_placement(in);
  TORCH_CHECK(camera.size() == 18 && width > 0 && height > 0, "sw_rasterizers: malformed camera");
  return render_on_cuda(in, camera, width, height);
}

// Gradients in two ops, so that what the first one needs, the image's gradient and the lists, is free again before the
// second one allocates the gradients of the inputs, which are larger than all else.
//
// rows: [N, row_length] sums of every Gaussian, zeros where it was not drawn.
std::tuple<Tensor, std::vector<double>> blend_backward_on_cuda(
    std::vector<Tensor> saved, const OptionalTensor& background, at::ArrayRef<double> camera, int64_t width,
    int64_t height, int64_t gaussians, int64_t color_channels, int64_t feature_channels, int64_t flags,
    const Tensor& image_gradient, const OptionalTensor& alpha_gradient, const OptionalTensor& median_gradient) {
  TORCH_CHECK(saved.size() == kSavedCount, "sw_rasterizers: the forward pass kept no state for the backward pass");
  const Channels channels{int(color_channels), (flags & kInverseDepth) != 0, (flags & kAccumulatedDepth) != 0,
                          int(feature_channels)};
  for (const OptionalTensor* t : {&alpha_gradient, &median_gradient, &background})
    TORCH_CHECK(!t->has_value() || ((*t)->is_contiguous() && (*t)->device() == image_gradient.device()),
                "sw_rasterizers: gradients and background must be contiguous and on one device");
  TORCH_CHECK(image_gradient.is_contiguous() && image_gradient.scalar_type() == at::kFloat &&
                  image_gradient.sizes() == at::IntArrayRef({channels.total(), height, width}),
              "sw_rasterizers: the image's gradient must be contiguous float32 of shape [", channels.total(), ", ", height,
              ", ", width, "], got ", image_gradient.sizes());
  const c10::cuda::CUDAGuard guard(image_gradient.device());
  const cudaStream_t stream = c10::cuda::getCurrentCUDAStream();
  const auto view = View<float>::from(camera.data(), int(width), int(height));
  StageClock clock{(flags & kCount) != 0, stream, {}};
  clock.mark();

  const bool absgrad = flags & kAbsgrad, median = flags & kMedianDepth;
  const int length = row_length(channels.total(), absgrad, median);
  const Tensor row_memory = at::zeros({gaussians, length}, image_gradient.options().requires_grad(false));
  const Rows rows{data<float>(row_memory), length, channels.total(), absgrad, median};
  Image image{};
  image.channels = channels.total(), image.color_channels = channels.colors;
  image.background = data<float>(background);
  image.background_is_image = background.has_value() && background->dim() == 3;
  image.transmittance = data<float>(saved[kTransmittance]), image.last = data<int32_t>(saved[kLast]);
  image.median_splat = data<int32_t>(saved[kMedianSplat]);
  const ImageGradient gradient{data<float>(image_gradient), data<float>(alpha_gradient), data<float>(median_gradient)};
  const Splats splats = splats_of(saved[kShape], saved[kTail], saved[kChannelRows]);
  const bool general = channels.total() != 3 || channels.colors != 3 || median;
  if (saved[kSplat].numel() > 0)
    blend_backward(view, flags & kPassClamp, splats, {data<int32_t>(saved[kTileStart]), data<int32_t>(saved[kSplat])},
                   image, general, gradient, flags & kDetachFeatures ? channels.features : 0, rows, stream);
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  clock.mark();
  return {row_memory, clock.seconds()};
}

std::tuple<std::vector<Tensor>, std::vector<double>> project_backward_on_cuda(
    const Tensor& means, const Tensor& opacities, const OptionalTensor& scales, const OptionalTensor& quats,
    const OptionalTensor& cov3d, const OptionalTensor& sh, const OptionalTensor& sh_dc, const OptionalTensor& sh_rest,
    const OptionalTensor& colors, const OptionalTensor& features, at::ArrayRef<double> camera, int64_t width,
    int64_t height, int64_t sh_degree, double scale_modifier, double eps2d, int64_t flags, const Tensor& drawn,
    const Tensor& row_memory, std::array<bool, kWantedCount> wanted) {
  const OptionalTensor none;
  const Inputs in{means,    opacities, scales, quats,     cov3d,          sh,    sh_dc, sh_rest, colors,
                  features, none,      none,   sh_degree, scale_modifier, eps2d, flags};
  in.check();
  check_placement(in);
  const auto channels = in.channels();
  const bool absgrad = flags & kAbsgrad, median = flags & kMedianDepth;
  const int length = row_length(channels.total(), absgrad, median);
  const int64_t n = means.size(0);
  in.check_shape("rows", row_memory, {n, length});
  in.check_shape("drawn", drawn, {n});
  const c10::cuda::CUDAGuard guard(means.device());
  const cudaStream_t stream = c10::cuda::getCurrentCUDAStream();
  const auto view = View<float>::from(camera.data(), int(width), int(height));
  const auto g = in.gaussians<float>();
  const auto real = means.options().requires_grad(false);
  StageClock clock{(flags & kCount) != 0, stream, {}};
  clock.mark();

  std::vector<Tensor> grads(kWantedCount);
  const auto want = [&](int which, const OptionalTensor& like) {
    grads[which] = at::empty(wanted[which] && like.has_value() ? like->sizes() : at::IntArrayRef{0}, real);
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
  const auto screen = [&](int which) {
    grads[which] = at::empty({wanted[which] ? n : 0, 2}, real);
    return data<float>(grads[which]);
  };
  out.grad2d = screen(kWantGrad2d);
  out.absgrad2d = screen(kWantAbsgrad2d);
  const Rows rows{data<float>(row_memory), length, channels.total(), absgrad, median};
  if (n > 0) project_backward(view, g, in.settings(), channels, data<uint8_t>(drawn), rows, out, stream);
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  clock.mark();
  return {std::move(grads), clock.seconds()};
}

Tensor visible_radii_on_cuda(const Tensor& means, const OptionalTensor& scales, const OptionalTensor& quats,
                             const OptionalTensor& cov3d, const OptionalTensor& visible, at::ArrayRef<double> camera,
                             int64_t width, int64_t height, double scale_modifier, double eps2d) {
  const OptionalTensor none, colors = means;
  const Tensor opacities = at::empty({0}, means.options());
  const Inputs in{means,  opacities, scales,  quats, cov3d, none,           none,  none,
                  colors, none,      visible, none,  0,     scale_modifier, eps2d, 0};
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

TORCH_LIBRARY_IMPL(sw_rasterizers, CUDA, m) {
  m.impl("render", render);
  m.impl("blend_backward", blend_backward_on_cuda);
  m.impl("project_backward", project_backward_on_cuda);
  m.impl("visible_radii", visible_radii_on_cuda);
}

#endif  // SW_WITH_CUDA
