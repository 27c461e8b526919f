// The op torch.ops.sw_rasterizers.accumulate_scores on CUDA: `render` makes the lists and the pixels' state, the sums
// are formed by cuda/scores.cu and cuda/fisher.cu. Compiled only where there is CUDA.
#ifdef SW_WITH_CUDA

#include <ATen/core/Tensor.h>
#include <ATen/ops/zeros.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>
#include <torch/library.h>

#include <tuple>
#include <vector>

#include "binding_cuda.h"
#include "binding_scores.h"
#include "binding_state.h"
#include "score_kernels.h"

namespace {

using namespace sw;        // NOLINT: one file
using namespace sw::cuda;  // NOLINT

void accumulate_scores(const Tensor& means, const Tensor& opacities, const OptionalTensor& scales,
                       const OptionalTensor& quats, const OptionalTensor& cov3d, const OptionalTensor& sh,
                       const OptionalTensor& sh_dc, const OptionalTensor& sh_rest, const OptionalTensor& colors,
                       const OptionalTensor& visible, const OptionalTensor& background, at::ArrayRef<double> camera,
                       int64_t width, int64_t height, int64_t sh_degree, double scale_modifier, double eps2d,
                       int64_t flags, at::ArrayRef<int64_t> kinds, at::ArrayRef<int64_t> rules,
                       at::ArrayRef<double> gammas, at::ArrayRef<int64_t> weight_rows, const OptionalTensor& weights,
                       Tensor totals, const OptionalTensor& blocks) {
  const OptionalTensor none;
  const Inputs in{means, opacities, scales,     quats,     cov3d,          sh,    sh_dc, sh_rest, colors,
                  none,  visible,   background, sh_degree, scale_modifier, eps2d, flags};
  const ScoreInputs asked{kinds, rules, weight_rows, gammas, weights, totals, blocks};
  asked.check(in, camera, width, height);
  if (means.size(0) == 0) return;
  const c10::cuda::CUDAGuard guard(means.device());
  const cudaStream_t stream = c10::cuda::getCurrentCUDAStream();
  const Inputs drawn{means, opacities, scales,     quats,     cov3d,          sh,    sh_dc, sh_rest, colors,
                     none,  visible,   background, sh_degree, scale_modifier, eps2d,
                     (flags | kSave | kForScores) & ~int64_t(kCount)};
  drawn.check();
  check_placement(drawn);
  const Rendered rendered = render_on_cuda(drawn, camera, width, height);
  const std::vector<Tensor>& saved = std::get<4>(rendered);
  TORCH_CHECK(saved.size() == kFlags + 1, "sw_rasterizers: the forward pass kept another state than expected");
  if (saved[kSplat].numel() == 0) return;

  const auto view = View<float>::from(camera.data(), int(width), int(height));
  const Splats splats = splats_of(saved[kShape], saved[kChannelRows]);
  const TileLists lists{data<int32_t>(saved[kTileStart]), data<int32_t>(saved[kSplat])};
  Ordered ordered{};
  Tensor pair_sums;
  Grouped pairs_of_splat;
  if (flags & kOrdered) {
    ordered.pairs = saved[kSplat].numel(), ordered.splats = saved[kShape].size(0);
    const int64_t floats = blocks.has_value() ? kFisherParts * kFisherSums : kScoreParts;
    pair_sums = at::empty({ordered.pairs, floats}, means.options().requires_grad(false));
    pairs_of_splat = Grouped(saved[kSplat], ordered.splats, stream);
    ordered.pair_sums = data<float>(pair_sums), ordered.pairs_of_splat = pairs_of_splat.groups();
  }
  Totals to{};
  const Scores<float> contributions = asked.select<float>(false, to.of);
  if (contributions.count > 0) score_pixels(view, splats, lists, contributions, to, ordered, stream);

  Image image{};
  image.background = data<float>(in.background);
  image.background_is_image = in.background.has_value() && in.background->dim() == 3;
  image.transmittance = data<float>(saved[kTransmittance]), image.last = data<int32_t>(saved[kLast]);
  const bool pass_clamp = flags & kPassClamp;
  const Scores<float> sensitive = asked.select<float>(true, to.of);
  if (sensitive.count > 0) sensitivity_scores(view, pass_clamp, splats, lists, image, sensitive, to, ordered, stream);
  if (blocks.has_value()) {
    const int64_t used = saved[kShape].size(0);
    const Tensor rows = at::zeros({used, kFisherSums}, means.options().requires_grad(false));
    fisher_sums(view, pass_clamp, splats, lists, image, data<float>(rows), ordered, stream);
    fisher_blocks(view, in.gaussians<float>(), in.settings(), int(used), splats, data<uint8_t>(saved[kFlags]),
                  data<float>(rows), data<double>(blocks.value()), stream);
  }
  C10_CUDA_KERNEL_LAUNCH_CHECK();
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sw_rasterizers, m) {
  // kinds: enum ScoreKind; rules: 1 tested, 0 blended; weight_rows: which of `weights` [M,H,W], of a
  // removal the first of its residual's three, or -1. Adds to `totals` [scores, N] and `blocks` [N, 21], both float64, and so may be called for one view after another.
  m.def(
      "accumulate_scores(Tensor means, Tensor opacities, Tensor? scales, Tensor? quats, Tensor? cov3d, Tensor? sh, "
      "Tensor? sh_dc, Tensor? sh_rest, Tensor? colors, Tensor? visible, Tensor? background, float[] camera, int width, "
      "int height, int sh_degree, float scale_modifier, float eps2d, int flags, int[] kinds, int[] rules, "
      "float[] gammas, int[] weight_rows, Tensor? weights, Tensor(a!) totals, Tensor(b!)? blocks) -> ()");
}

TORCH_LIBRARY_IMPL(sw_rasterizers, CUDA, m) { m.impl("accumulate_scores", accumulate_scores); }

#endif  // SW_WITH_CUDA
