// The op torch.ops.sw_rasterizers.accumulate_scores: memory, types and shapes; the work is done in cpu/scores.cpp and
// cpu/fisher.cpp on what the standard kernels project and sort.
#include <ATen/Parallel.h>
#include <torch/library.h>

#include <vector>

#include "binding_memory.h"
#include "binding_scores.h"
#include "cpu/score_kernels.h"

namespace {

using namespace sw;  // NOLINT: one file

template <class S>
void accumulate_as(const Inputs& in, const ScoreInputs& asked, at::ArrayRef<double> camera, int64_t width,
                   int64_t height) {
  const auto view = View<S>::from(camera.data(), int(width), int(height));
  const auto g = in.gaussians<S>();
  const auto settings = in.settings();
  const auto channels = in.channels();
  const bool fisher = asked.blocks.has_value();
  const int64_t n = g.count, chunks = (n + kChunk - 1) / kChunk, tiles = int64_t(view.tiles_x()) * view.tiles_y();
  if (n == 0) return;
  const auto real = in.means.options().requires_grad(false);
  const auto make = [&](at::IntArrayRef shape) { return make_tensor(shape, real); };
  const auto make_as = [&](at::IntArrayRef shape, at::ScalarType type) { return make_tensor(shape, real.dtype(type)); };

  const Tensor records = make({n, kRecord}), index = make_as({n}, at::kInt), per_chunk = make_as({chunks}, at::kInt);
  const Tensor runs = make_as({n, 2}, at::kInt), clamped = make_as({n}, at::kByte), radii = make_as({n}, at::kInt);
  const Tensor slope = make({fisher && g.colors == nullptr && g.sh_degree > 0 ? n : 0, 9});
  const Tensor channel_rows = make({in.plain() ? 0 : n, channels.total()});
  std::vector<std::vector<int32_t>> tile_lists(static_cast<size_t>(chunks));
  const Slots<S> slots{data<S>(records),    data<int32_t>(index), data<int32_t>(per_chunk), data<PairRun>(runs),
                       tile_lists.data(),   data<S>(slope),       data<uint8_t>(clamped),   data<S>(channel_rows)};
  int64_t seen[3] = {0, 0, 0};
  const int64_t used =
      SW_SELECT(project_gaussians<S>)(view, g, settings, channels, slots, data<int32_t>(radii), seen);
  const int64_t count = SW_SELECT(count_pairs<S>)(n, slots);
  check_pairs_on_cpu(seen[2], settings);
  if (count == 0) return;

  const Tensor order = make_as({used}, at::kInt);
  SW_SELECT(depth_order<S>)(n, used, slots, settings.threads, data<int32_t>(order));
  const bool sensitive = asked.wants_sensitivity();
  const Tensor tile_start = make_as({tiles + 1}, at::kLong), slot = make_as({count}, at::kInt);
  const Tensor origin = make_as({count}, at::kInt), touched = make_as({sensitive ? count : 0}, at::kInt);
  const Pairs<S> pairs{count, data<int64_t>(tile_start), data<int32_t>(slot), data<int32_t>(origin),
                       data<uint32_t>(touched)};
  SW_SELECT(bin_pairs<S>)(view, settings, n, used, slots, data<int32_t>(order), pairs);

  double* to[kMaxScores];
  const Scores<S> contributions = asked.select<S>(false, to);
  if (contributions.count > 0) {
    const Tensor sums = make({count, contributions.count});
    SW_SELECT(score_pairs<S>)(view, settings, slots, pairs, contributions, data<S>(sums));
    SW_SELECT(add_scores<S>)(n, settings, slots, contributions, data<S>(sums), to);
  }
  if (!sensitive) return;

  const Tensor transmittance = make({tiles, kTilePixels}), last = make_as({tiles, kTilePixels}, at::kInt);
  const Tensor image = make({channels.total(), height, width});
  Canvas<S> canvas{};
  canvas.channels = channels.total(), canvas.color_channels = channels.colors;
  canvas.image = data<S>(image);
  canvas.background = data<S>(in.background);
  canvas.background_is_image = in.background.has_value() && in.background->dim() == 3;
  canvas.transmittance = data<S>(transmittance), canvas.last = data<int32_t>(last);
  SW_SELECT(blend<S>)(view, settings, slots, pairs, canvas);
  const Scores<S> sensitive_scores = asked.select<S>(true, to);
  if (sensitive_scores.count > 0) {
    const Sensitivity<S> what{false, &sensitive_scores};
    const Tensor sums = make({count, what.columns()});
    SW_SELECT(sensitivity_pairs<S>)(view, settings, slots, pairs, canvas, what, data<S>(sums));
    SW_SELECT(add_scores<S>)(n, settings, slots, sensitive_scores, data<S>(sums), to);
  }
  if (fisher) {
    const Sensitivity<S> what{true, nullptr};
    const Tensor sums = make({count, what.columns()});
    SW_SELECT(sensitivity_pairs<S>)(view, settings, slots, pairs, canvas, what, data<S>(sums));
    SW_SELECT(add_fisher<S>)(view, g, settings, slots, data<S>(sums), data<double>(asked.blocks.value()));
  }
}

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
  means.scalar_type() == at::kDouble ? accumulate_as<double>(in, asked, camera, width, height)
                                     : accumulate_as<float>(in, asked, camera, width, height);
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

TORCH_LIBRARY_IMPL(sw_rasterizers, CPU, m) { m.impl("accumulate_scores", accumulate_scores); }
