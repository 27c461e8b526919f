// From the pair sums of every splat to the gradients of what was put in.
//
// A thread takes a chunk of Gaussians: it zeroes the chunk's rows of every gradient (culled Gaussians get exactly 0)
// and fills those of the drawn ones while they are still in its cache, so each gradient goes to memory once. The
// projection is computed again, which is cheaper than to have stored it.
#include <algorithm>

#include "../projection.h"
#include "gather.h"
#include "kernels.h"
#include "parallel.h"
#include "shade.h"
#include "shape.h"

namespace SW_ARCH {
namespace {

template <class V, bool kCov3d>
struct ChunkBackward {
  using S = Scalar<V>;
  static constexpr int L = lanes_of<V>;
  const View<S>& view;
  const Gaussians<S>& g;
  const Settings& settings;
  const Channels& channels;
  const Slots<S>& slots;
  const S* sums;
  int columns;
  const Gradients<S>& out;

  // `shape_sums`: of the chunk's group, where shapes are shared.
  void operator()(int64_t chunk, S* shape_sums) const {
    const int64_t begin = chunk * kChunk, end = std::min(begin + kChunk, g.count);
    const auto clear = [&](S* base, int64_t stride) {
      if (base != nullptr) std::fill(base + begin * stride, base + end * stride, S(0));
    };
    clear(out.means, 3), clear(out.opacities, 1), clear(out.cov3d, 6);
    if (g.shape_rows == nullptr) clear(out.scales, 3), clear(out.quats, 4);
    clear(out.scale_factors, 1);
    clear(out.colors, channels.colors), clear(out.features, channels.features);
    clear(out.grad2d, 2), clear(out.absgrad2d, 2);
    clear(out.sh_dc, out.sh_dc_stride);
    if (out.sh_dc == nullptr || out.sh_rest != out.sh_dc + 3)
      clear(out.sh_rest, out.sh_rest_stride);  // else one tensor
    for (int64_t s = begin, stop = begin + slots.per_chunk[chunk]; s < stop; s += L) backward_pack(s, stop, shape_sums);
  }

  void backward_pack(int64_t first, int64_t end, S* shape_sums) const {
    const auto c = [](double value) { return constant<V>(value); };
    const int lanes = int(std::min<int64_t>(end - first, L));
    alignas(64) int32_t rows[L];
    for (int i = 0; i < L; ++i) rows[i] = slots.index[first + (i < lanes ? i : lanes - 1)];

    // Add up the pairs of each splat, one field a pack.
    alignas(64) S fixed[kPlainColumns][L];  // moments, RGB, absgrad
    alignas(64) S depth_gradient[L] = {};
    for (int i = 0; i < L; ++i) {
      const int64_t slot = first + (i < lanes ? i : lanes - 1);
      const S* row = sums + int64_t(slots.run[slot].first) * columns;
      S total[kPlainColumns] = {};
      if (slots.channels == nullptr) {
        for (int n = 0; n < slots.run[slot].count; ++n, row += kPlainColumns)
          for (int k = 0; k < kPlainColumns; ++k) total[k] += row[k];
      } else if (i < lanes) {
        depth_gradient[i] = add_up_general(slot, row, total);
      }
      for (int k = 0; k < kPlainColumns; ++k) fixed[k][i] = total[k];
    }

    Geometry<V> in;
    gather_rows<V, 3>(g.means, 3, rows, in.mean);
    if constexpr (kCov3d) {
      gather_rows<V, 6>(g.cov3d, 6, rows, in.cov);
    } else {
      gather_shape<V>(g, rows, in);
    }
    V opacity;
    gather_rows<V, 1>(g.opacities, 1, rows, &opacity);
    Projection<V> p;
    project<kCov3d>(view, S(settings.scale_modifier), S(settings.eps2d), settings.antialias, in, p);

    const auto sum = [&](int k) { return load<V>(fixed[k]); };
    ScreenGradient<V> grad;
    grad.u = p.ka * sum(kVx) + p.kb * sum(kVy);
    grad.v = p.kb * sum(kVx) + p.kc * sum(kVy);
    grad.ka = c(0.5) * sum(kVxx);
    grad.kb = sum(kVxy);
    grad.kc = c(0.5) * sum(kVyy);
    grad.opacity = -sum(kV0) / (opacity * p.rho);  // sum of -v = sum of alpha dL/dalpha
    grad.depth = load<V>(depth_gradient);
    GeometryGradient<V> result;
    project_backward<kCov3d>(view, S(settings.scale_modifier), S(settings.eps2d), settings.antialias,
                             settings.original_jacobian, in, p, opacity, grad, result);

    if (g.sh_dc != nullptr)
      ColorBackward<V>{view, g, slots, out}(first, lanes, rows, in.mean, fixed + kMoments, result.mean);
    if (out.colors != nullptr && slots.channels == nullptr)
      for (int i = 0; i < lanes; ++i)
        for (int k = 0; k < 3; ++k) out.colors[int64_t(rows[i]) * 3 + k] = fixed[kMoments + k][i];
    if (out.means != nullptr) scatter_rows<V, 3>(result.mean, out.means, 3, rows, lanes);
    if (out.opacities != nullptr) scatter_rows<V, 1>(&result.opacity, out.opacities, 1, rows, lanes);
    if constexpr (kCov3d) {
      if (out.cov3d != nullptr) scatter_rows<V, 6>(result.cov, out.cov3d, 6, rows, lanes);
    } else {
      scatter_shape<V>(g, out, shape_sums, rows, lanes, result.scale, result.quat);
    }
    // NDC units: pixel gradient times half the image size.
    const V half_width = c(0.5 * view.width), half_height = c(0.5 * view.height);
    if (out.grad2d != nullptr) {
      const V ndc[2] = {half_width * grad.u, half_height * grad.v};
      scatter_rows<V, 2>(ndc, out.grad2d, 2, rows, lanes);
    }
    if (out.absgrad2d != nullptr) {
      V found[2] = {sum(kMoments + 3), sum(kMoments + 4)};
      if (!settings.fragments) found[0] *= half_width, found[1] *= half_height;
      scatter_rows<V, 2>(found, out.absgrad2d, 2, rows, lanes);
    }
  }

  // Channels other than plain RGB: adds up the rows of one splat into `total` (as in the plain case), writes the
  // gradients of colours and features, returns dL/dtz.
  S add_up_general(int64_t slot, const S* row, S* total) const {
    const int64_t n = slots.index[slot];
    const auto column = [&](int k) {
      S value = 0;
      for (int p = 0; p < slots.run[slot].count; ++p) value += row[int64_t(p) * columns + k];
      return value;
    };
    for (int k = 0; k < kMoments; ++k) total[k] = column(k);
    int at = kMoments;
    for (int k = 0; k < channels.colors; ++k) {
      const S value = column(at++);
      if (k < 3) total[kMoments + k] = value;
      if (out.colors != nullptr) out.colors[n * channels.colors + k] = value;
    }
    const S depth = slots.records[slot * kRecord + kDepth];
    S gradient = 0;
    if (channels.inverse) gradient -= column(at++) / (depth * depth);
    if (channels.accumulated) gradient += column(at++);
    for (int k = 0; k < channels.features; ++k, ++at)
      if (out.features != nullptr) out.features[n * channels.features + k] = column(at);
    if (settings.absgrad)
      for (int k = 0; k < 2; ++k) total[kMoments + 3 + k] = column(at++);
    if (settings.median_depth) gradient += column(at);
    return gradient;
  }
};

// Sums of the groups, in their order, to the gradients of the shared shapes.
template <class S>
void add_up_groups(const splatwizard::Parallel* threads, int64_t groups, int64_t shapes, const Gradients<S>& out) {
  parallel_dynamic(threads, (shapes + kChunk - 1) / kChunk, [&](int64_t chunk) {
    for (int64_t m = chunk * kChunk; m < std::min((chunk + 1) * kChunk, shapes); ++m) {
      S total[kShapeSums] = {};
      for (int64_t group = 0; group < groups; ++group)
        for (int k = 0; k < kShapeSums; ++k) total[k] += out.shape_sums[(group * shapes + m) * kShapeSums + k];
      if (out.scales != nullptr) std::copy_n(total, 3, out.scales + 3 * m);
      if (out.quats != nullptr) std::copy_n(total + 3, 4, out.quats + 4 * m);
    }
  });
}

template <class V, bool kCov3d>
void backward_all(const View<Scalar<V>>& view, const Gaussians<Scalar<V>>& g, const Settings& settings,
                  const Channels& channels, const Slots<Scalar<V>>& slots, const Scalar<V>* sums,
                  const Gradients<Scalar<V>>& out) {
  const int columns =
      pair_columns(slots.channels == nullptr, channels.total(), settings.absgrad, settings.median_depth);
  const ChunkBackward<V, kCov3d> backward_chunk{view, g, settings, channels, slots, sums, columns, out};
  const int64_t chunks = (g.count + kChunk - 1) / kChunk;
  if (out.shape_sums == nullptr) {
    parallel_dynamic(settings.parallel, chunks, [&](int64_t chunk) { backward_chunk(chunk, nullptr); });
    return;
  }
  const int64_t groups = shape_groups(g.count, g.shapes), floats = g.shapes * kShapeSums;
  parallel_dynamic(settings.parallel, groups, [&](int64_t group) {
    Scalar<V>* sums = out.shape_sums + group * floats;
    std::fill_n(sums, floats, Scalar<V>(0));
    for (int64_t chunk = group * chunks / groups; chunk < (group + 1) * chunks / groups; ++chunk)
      backward_chunk(chunk, sums);
  });
  add_up_groups(settings.parallel, groups, g.shapes, out);
}

}  // namespace

#define SW_INSTANTIATE(S, V)                                                                                          \
  template <>                                                                                                         \
  void project_backward<S>(const View<S>& view, const Gaussians<S>& g, const Settings& settings,                      \
                           const Channels& channels, const Slots<S>& slots, const S* sums, const Gradients<S>& out) { \
    g.cov3d != nullptr ? backward_all<V, true>(view, g, settings, channels, slots, sums, out)                         \
                       : backward_all<V, false>(view, g, settings, channels, slots, sums, out);                       \
  }
SW_INSTANTIATE(float, Lanes)
SW_INSTANTIATE(double, double)
#undef SW_INSTANTIATE

}  // namespace SW_ARCH
