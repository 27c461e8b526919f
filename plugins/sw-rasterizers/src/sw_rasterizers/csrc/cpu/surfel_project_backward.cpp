// From the pair sums of every surfel to the gradients of what was put in: as project_backward.cpp.
#include <algorithm>

#include "gather.h"
#include "parallel.h"
#include "shade.h"
#include "surfel_kernels.h"

namespace SW_ARCH {
namespace {

template <class V>
struct ChunkBackward {
  using S = Scalar<V>;
  static constexpr int L = lanes_of<V>;
  const View<S>& view;
  const Gaussians<S>& g;
  const Settings& settings;
  const Slots<S>& slots;
  const S* sums;
  bool maps;
  const Gradients<S>& out;

  void operator()(int64_t chunk) const {
    const int64_t begin = chunk * kChunk, end = std::min(begin + kChunk, g.count);
    const auto clear = [&](S* base, int64_t stride) {
      if (base != nullptr) std::fill(base + begin * stride, base + end * stride, S(0));
    };
    clear(out.means, 3), clear(out.opacities, 1), clear(out.scales, 2), clear(out.quats, 4), clear(out.colors, 3);
    clear(out.grad2d, 2), clear(out.sh_dc, out.sh_dc_stride);
    if (out.sh_dc == nullptr || out.sh_rest != out.sh_dc + 3) clear(out.sh_rest, out.sh_rest_stride);  // else one
    for (int64_t s = begin, stop = begin + slots.per_chunk[chunk]; s < stop; s += L) backward_pack(s, stop);
  }

  void backward_pack(int64_t first, int64_t end) const {
    const int lanes = int(std::min<int64_t>(end - first, L));
    alignas(64) int32_t rows[L];
    alignas(64) S fixed[kSurfelColumns][L] = {};
    const int columns = surfel_columns(maps);
    for (int i = 0; i < L; ++i) {
      const int64_t slot = first + (i < lanes ? i : lanes - 1);
      rows[i] = slots.index[slot];
      const S* row = sums + int64_t(slots.run[slot].first) * columns;
      S total[kSurfelColumns] = {};
      for (int n = 0; n < slots.run[slot].count; ++n, row += columns)
        for (int k = 0; k < columns; ++k) total[k] += row[k];
      for (int k = 0; k < columns; ++k) fixed[k][i] = total[k];
    }

    SurfelGeometry<V> in;
    gather_rows<V, 3>(g.means, 3, rows, in.mean);
    gather_rows<V, 2>(g.scales, 2, rows, in.scale);
    gather_rows<V, 4>(g.quats, 4, rows, in.quat);
    V opacity, sum[kSurfelColumns];
    gather_rows<V, 1>(g.opacities, 1, rows, &opacity);
    for (int k = 0; k < kSurfelColumns; ++k) sum[k] = load<V>(fixed[k]);
    SurfelProjection<V> p;
    SurfelGradient<V> result;
    project_surfel(view, S(settings.scale_modifier), in, p);
    surfel_backward(view, S(settings.scale_modifier), p, opacity, sum, maps, result);

    if (g.sh_dc != nullptr)
      ColorBackward<V>{view, g, slots, out}(first, lanes, rows, in.mean, fixed + kSumRed, result.mean);
    if (out.colors != nullptr)
      for (int i = 0; i < lanes; ++i)
        for (int k = 0; k < 3; ++k) out.colors[int64_t(rows[i]) * 3 + k] = fixed[kSumRed + k][i];
    if (out.means != nullptr) scatter_rows<V, 3>(result.mean, out.means, 3, rows, lanes);
    if (out.opacities != nullptr) scatter_rows<V, 1>(&result.opacity, out.opacities, 1, rows, lanes);
    if (out.scales != nullptr) scatter_rows<V, 2>(result.scale, out.scales, 2, rows, lanes);
    if (out.quats != nullptr) scatter_rows<V, 4>(result.quat, out.quats, 4, rows, lanes);
    if (out.grad2d != nullptr) {
      // NDC units: pixel gradient times half the image size.
      const V half_width = constant<V>(0.5 * view.width), half_height = constant<V>(0.5 * view.height);
      const V ndc[2] = {half_width * result.shift_x, half_height * result.shift_y};
      scatter_rows<V, 2>(ndc, out.grad2d, 2, rows, lanes);
    }
  }
};

}  // namespace

#define SW_INSTANTIATE(S, V)                                                                                      \
  template <>                                                                                                     \
  void project_surfels_backward<S>(const View<S>& view, const Gaussians<S>& g, const Settings& settings,          \
                                   const Slots<S>& slots, const S* sums, bool maps, const Gradients<S>& out) {    \
    const ChunkBackward<V> backward_chunk{view, g, settings, slots, sums, maps, out};                             \
    parallel_dynamic(settings.parallel, (g.count + kChunk - 1) / kChunk, backward_chunk);                          \
  }
SW_INSTANTIATE(float, Lanes)
SW_INSTANTIATE(double, double)
#undef SW_INSTANTIATE

}  // namespace SW_ARCH
