// The op torch.ops.sw_rasterizers.draw, differentiable: two nodes of autograd in C++, since the same two in Python took
// the host longer than small pictures take the device. Compiled only where there is CUDA.
#ifdef SW_WITH_CUDA

#include <ATen/core/LegacyTypeDispatch.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_strided.h>
#include <ATen/ops/zeros.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/library.h>

#include <array>
#include <mutex>
#include <tuple>
#include <utility>
#include <vector>

#include "binding_cuda.h"
#include "binding_state.h"

namespace {

using namespace sw;        // NOLINT: one file
using namespace sw::cuda;  // NOLINT
using torch::autograd::AutogradContext;
using torch::autograd::Function;
using torch::autograd::variable_list;

constexpr int kInputs = kWantGrad2d;  // tensors to differentiate by, in the order of Wanted
using Given = std::array<OptionalTensor, kInputs>;

// A call on its way from one node to the other, and which inputs it has.
struct Drawing : DrawCall {
  std::array<bool, kInputs> present{};
  Rendered drawn;

  Inputs inputs(const Given& x) const {
    return {*x[kWantMeans], *x[kWantOpacities], x[kWantScales], x[kWantQuats], x[kWantCov3d],
            x[kWantSh], x[kWantShDc], x[kWantShRest], x[kWantColors], x[kWantFeatures], visible, background,
            sh_degree, scale_modifier, eps2d, flags, 3, x[kWantScaleFactors], geom_indices};
  }
  // `tensors`: those that are present.
  Given given(at::ArrayRef<Tensor> tensors) const {
    Given all;
    size_t next = 0;
    for (int i = 0; i < kInputs; ++i)
      if (present[size_t(i)]) all[size_t(i)] = tensors[next++];
    return all;
  }
};
using DrawingPtr = c10::intrusive_ptr<Drawing>;

void keep(AutogradContext* ctx, const DrawingPtr& call) {
  ctx->saved_data["call"] = c10::IValue::make_capsule(call);
  ctx->set_materialize_grads(false);
}
DrawingPtr kept(AutogradContext* ctx) {
  TORCH_CHECK(!at::GradMode::is_enabled(),
              "sw_rasterizers: gradients of a drawing cannot be differentiated again on CUDA (create_graph=True)");
  return c10::static_intrusive_pointer_cast<Drawing>(ctx->saved_data["call"].toCapsule());
}

// Seconds of the stages of the last backward pass that measured them.
std::mutex seconds_lock;
std::vector<double> blend_seconds, project_seconds;

void report(const DrawCall& call, std::vector<double>& to, std::vector<double>&& seconds) {
  if (!(call.flags & kCount)) return;
  const std::lock_guard hold(seconds_lock);
  if (&to == &blend_seconds) project_seconds.clear();  // of another pass
  to = std::move(seconds);
}

// First node: a stand-in [N, sums of a Gaussian] without memory, whose gradient is what Blend sums up over the pixels.
// All large state goes through save_for_backward, so that it is freed with the graph even if the result lives on.
struct Project : Function<Project> {
  // `inputs`: those that are present, then maybe one that only makes the backward pass happen.
  static Tensor forward(AutogradContext* ctx, const DrawingPtr& call, at::TensorList inputs) {
    const at::AutoDispatchBelowADInplaceOrView plain;
    variable_list stored;
    for (const Tensor& x : inputs) stored.push_back(x.contiguous());
    const Given given = call->given(stored);
    const Inputs in = call->inputs(given);
    in.check();
    check_placement(in);
    call->gaussians = in.means.size(0), call->channels = in.channels();
    call->drawn = render_on_cuda(in, call->camera, call->width, call->height);
    auto& saved = std::get<4>(call->drawn);
    stored.push_back(saved.back());  // the flags of the Gaussians
    saved.pop_back();
    const auto real = in.means.options().requires_grad(false);
    const int length = row_length(call->channels.total(), call->flags & kAbsgrad, call->flags & kMedianDepth);
    ctx->save_for_backward(std::move(stored));
    keep(ctx, call);
    return at::empty_strided({call->gaussians, length}, {0, 0}, real);
  }

  static variable_list backward(AutogradContext* ctx, const variable_list& rows) {
    const DrawingPtr call = kept(ctx);
    const at::AutoDispatchBelowADInplaceOrView plain;
    variable_list stored = ctx->get_saved_variables();
    const Given given = call->given(stored);
    std::array<bool, kWantedCount> wanted{};
    size_t edge = 0;
    for (size_t i = 0; i < size_t(kInputs); ++i)
      if (call->present[i]) wanted[i] = ctx->needs_input_grad(edge++);
    std::vector<double> seconds;
    const Inputs in = call->inputs(given);
    auto found = project_backward_on_cuda(in, *call, stored.back(), rows[0].contiguous(), wanted, seconds);
    report(*call, project_seconds, std::move(seconds));
    call->updated.clear();
    variable_list out(1);
    for (size_t i = 0; i < size_t(kInputs); ++i)
      if (call->present[i]) out.push_back(std::move(found[i]));
    out.resize(out.size() + 1);  // of the one that only makes the backward pass happen
    return out;
  }
};

// Second node: image, radii, alpha, median depth.
struct Blend : Function<Blend> {
  static variable_list forward(AutogradContext* ctx, const DrawingPtr& call, const Tensor&) {
    auto& [image, radii, alpha, median, saved, counts, seconds] = call->drawn;
    ctx->mark_non_differentiable({radii});
    ctx->save_for_backward(std::move(saved));
    keep(ctx, call);
    return {image, radii, alpha, median};
  }

  static variable_list backward(AutogradContext* ctx, const variable_list& grads) {
    const DrawingPtr call = kept(ctx);
    const at::AutoDispatchBelowADInplaceOrView plain;
    const variable_list saved = ctx->get_saved_variables();
    const auto nonempty = [](const Tensor& x) -> OptionalTensor {
      if (!x.defined() || x.numel() == 0) return {};
      return x.contiguous();
    };
    const Tensor image = grads[0].defined() ? grads[0].contiguous()
                                            : at::zeros({call->channels.total(), call->height, call->width},
                                                        saved[kTransmittance].options());
    std::vector<double> seconds;
    Tensor rows = blend_backward_on_cuda(*call, saved, image, nonempty(grads[2]), nonempty(grads[3]), seconds);
    report(*call, blend_seconds, std::move(seconds));
    return {Tensor(), std::move(rows)};
  }
};

std::tuple<Tensor, Tensor, Tensor, Tensor, std::vector<int64_t>, std::vector<double>, std::vector<Tensor>> draw(
    const Tensor& means, const Tensor& opacities, const OptionalTensor& scales, const OptionalTensor& quats,
    const OptionalTensor& cov3d, const OptionalTensor& sh, const OptionalTensor& sh_dc, const OptionalTensor& sh_rest,
    const OptionalTensor& colors, const OptionalTensor& features, const OptionalTensor& scale_factors,
    const OptionalTensor& geom_indices, const OptionalTensor& visible, const OptionalTensor& background,
    at::ArrayRef<double> camera, int64_t width, int64_t height, int64_t sh_degree, double scale_modifier, double eps2d,
    int64_t flags, bool grad2d, bool absgrad2d, std::vector<Tensor> updated, std::vector<double> rates) {
  TORCH_CHECK(means.is_cuda(), "sw_rasterizers: draw is for CUDA, means are on ", means.device());
  TORCH_CHECK(camera.size() == 18 && width > 0 && height > 0, "sw_rasterizers: malformed camera");
  TORCH_CHECK(updated.empty() || (updated.size() == 6 && rates.size() == 12),
              "sw_rasterizers: Adam in the backward pass takes three tensors and six numbers for each of sh_dc, "
              "sh_rest");
  const auto call = c10::make_intrusive<Drawing>();
  call->camera = camera.vec();
  call->width = width, call->height = height, call->sh_degree = sh_degree;
  call->scale_modifier = scale_modifier, call->eps2d = eps2d, call->flags = flags | kSave;
  call->geom_indices = geom_indices, call->visible = visible, call->background = background;
  call->updated = std::move(updated), call->rates = std::move(rates);
  std::vector<Tensor> late;
  for (const auto& [wanted, place] : {std::pair{grad2d, &call->grad2d}, std::pair{absgrad2d, &call->absgrad2d}}) {
    if (!wanted) continue;
    *place = at::empty({0}, means.options().requires_grad(false));
    late.push_back(*place);
  }
  const Given given{means, opacities, scales, quats, cov3d, sh, sh_dc, sh_rest, colors, features, scale_factors};
  std::vector<Tensor> inputs;
  bool differentiable = false;
  for (size_t i = 0; i < size_t(kInputs); ++i) {
    call->present[i] = given[i].has_value();
    if (!call->present[i]) continue;
    inputs.push_back(*given[i]);
    differentiable |= given[i]->requires_grad();
  }
  // Statistics are wanted even if no input needs a gradient.
  if (!differentiable) inputs.push_back(at::empty({0}).set_requires_grad(true));
  const Tensor stand_in = Project::apply(call, at::TensorList(inputs));
  const variable_list out = Blend::apply(call, stand_in);
  auto counts = std::move(std::get<5>(call->drawn));
  auto seconds = std::move(std::get<6>(call->drawn));
  call->drawn = {};
  return {out[0], out[1], out[2], out[3], std::move(counts), std::move(seconds), std::move(late)};
}

std::vector<double> backward_seconds() {
  const std::lock_guard hold(seconds_lock);
  std::vector<double> all = blend_seconds;
  all.insert(all.end(), project_seconds.begin(), project_seconds.end());
  return all;
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sw_rasterizers, m) {
  m.def(
      "draw(Tensor means, Tensor opacities, Tensor? scales, Tensor? quats, Tensor? cov3d, Tensor? sh, "
      "Tensor? sh_dc, Tensor? sh_rest, Tensor? colors, Tensor? features, Tensor? scale_factors, Tensor? geom_indices, "
      "Tensor? visible, Tensor? background, float[] camera, int width, int height, int sh_degree, "
      "float scale_modifier, float eps2d, int flags, bool grad2d, bool absgrad2d, Tensor(a!)[] updated, float[] rates) "
      "-> (Tensor image, Tensor radii, Tensor alpha, Tensor median, int[] counts, float[] seconds, Tensor[] late)",
      draw);
  m.def("backward_seconds() -> float[]", backward_seconds);
}

#endif  // SW_WITH_CUDA
