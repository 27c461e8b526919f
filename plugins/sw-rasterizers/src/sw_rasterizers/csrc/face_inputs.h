// What stands behind the faces: their calls as the kernels take them, with their counts checked.
#pragma once

#include <splatwizard/c_face.h>

#include <chrono>
#include <limits>

#include "call.h"
#include "camera.h"
#include "flags.h"

namespace sw {

using splatwizard::Parallel;
using splatwizard::refuse;

// body(S()) with the number type of a call.
template <class Call, class Body>
int32_t with_numbers(Call* call, const Body& body) {
  return splatwizard::guarded(call, [&](const Parallel& parallel) {
    if (call->real_bytes == 4) return body(float(), parallel);
    if (call->real_bytes == 8) return body(double(), parallel);
    refuse("numbers of %d bytes: they have 4 or 8", int(call->real_bytes));
  });
}

template <class S>
const S* numbers(const void* at) {
  return static_cast<const S*>(at);
}
template <class S>
S* numbers(void* at) {
  return static_cast<S*>(at);
}

// Places in memory of the caller's, one after the other; where there is none, it only measures.
struct Layout {
  uint8_t* memory;
  int64_t bytes = 0;
  template <class T>
  T* take(int64_t count) {
    const int64_t at = bytes;
    bytes += (count * int64_t(sizeof(T)) + 63) / 64 * 64;
    return memory == nullptr || count == 0 ? nullptr : reinterpret_cast<T*>(memory + at);
  }
  void check(const char* name, int64_t given) const {
    if (given < bytes || reinterpret_cast<uintptr_t>(memory) % 64 != 0)
      refuse("%s needs %lld bytes from a multiple of 64 on, got %lld", name, (long long)bytes, (long long)given);
  }
};

struct Clock {
  std::chrono::steady_clock::time_point since = std::chrono::steady_clock::now();
  double lap() {
    const auto now = std::chrono::steady_clock::now();
    const double seconds = std::chrono::duration<double>(now - since).count();
    since = now;
    return seconds;
  }
};

template <class S, class Call>
View<S> view_of(const Call& call) {
  constexpr int64_t most = 1 << 20;
  if (call.width < 1 || call.height < 1 || call.width > most || call.height > most)
    refuse("an image of %lld x %lld", (long long)call.width, (long long)call.height);
  return View<S>::from(call.camera, int(call.width), int(call.height));
}

template <class S>
int64_t tiles_of(const View<S>& view) {
  return int64_t(view.tiles_x()) * view.tiles_y();
}

// `parallel` null: on a GPU.
inline Settings settings_of(int64_t flags, const Parallel* parallel) {
  Settings s;
  s.antialias = flags & kAntialias, s.clamp_color = flags & kClampColor, s.tight = flags & kTight;
  s.pass_clamp = flags & kPassClamp, s.original_jacobian = flags & kOriginalJacobian;
  s.inverse_depth = flags & kInverseDepth;
  s.accumulated_depth = flags & kAccumulatedDepth, s.median_depth = flags & kMedianDepth;
  s.detach_features = flags & kDetachFeatures, s.absgrad = flags & kAbsgrad;
  s.fragments = flags & kFragments;
  s.parallel = parallel;
  return s;
}
inline Settings settings_of(int64_t flags, const Parallel& parallel) { return settings_of(flags, &parallel); }

template <class Call>
Settings settings_of(const Call& call, const Parallel* parallel) {
  Settings s = settings_of(call.flags, parallel);
  s.scale_modifier = call.scale_modifier, s.eps2d = call.eps2d;
  return s;
}
template <class Call>
Settings settings_of(const Call& call, const Parallel& parallel) {
  return settings_of(call, &parallel);
}

// Means and shapes.
template <class S, class Call>
Gaussians<S> geometry_of(const Call& call) {
  constexpr int64_t most = std::numeric_limits<int32_t>::max();
  if (call.count < 0 || call.count >= most || call.shapes < 0 || call.shapes >= most)
    refuse("%lld Gaussians of %lld shapes: at most 2^31 - 2", (long long)call.count, (long long)call.shapes);
  const int columns = call.flags & kSurfels ? 2 : 3;
  if (call.count > 0 && (call.cov3d != nullptr) == (call.scales != nullptr && call.quats != nullptr))
    refuse("either scales and quats or cov3d is needed");
  if (call.cov3d != nullptr && (columns == 2 || call.geom_indices != nullptr || call.scale_factors != nullptr))
    refuse("cov3d excludes surfels, geom_indices and scale_factors");
  if (call.scales != nullptr && call.scale_columns != columns)
    refuse("scales must be [%lld, %d], got %lld columns", (long long)call.shapes, columns, (long long)call.scale_columns);
  if (call.count > 0 && call.scales != nullptr && call.geom_indices == nullptr && call.shapes != call.count)
    refuse("%lld scales of %lld Gaussians", (long long)call.shapes, (long long)call.count);
  Gaussians<S> g;
  g.count = call.count, g.shapes = call.shapes;
  g.means = numbers<S>(call.means);
  g.scales = numbers<S>(call.scales), g.quats = numbers<S>(call.quats), g.cov3d = numbers<S>(call.cov3d);
  g.scale_factors = numbers<S>(call.scale_factors), g.shape_rows = call.geom_indices;
  g.visible = call.visible;
  return g;
}

template <class S, class Call>
Gaussians<S> gaussians_of(const Call& call) {
  Gaussians<S> g = geometry_of<S>(call);
  g.opacities = numbers<S>(call.opacities);
  const bool dense = call.sh != nullptr;
  if (dense + (call.sh_dc != nullptr) + (call.colors != nullptr) > 1) refuse("sh, sh_dc and colors exclude each other");
  const int64_t basis = (call.sh_degree + 1) * (call.sh_degree + 1);
  const int64_t stored = dense ? call.sh_rows : call.sh_rest != nullptr ? 1 + call.rest_rows : 1;
  if (call.count > 0 && (call.sh_degree < 0 || call.sh_degree > 3 || basis > stored))
    refuse("SH degree %d needs %lld coefficients, got %lld", int(call.sh_degree), (long long)basis, (long long)stored);
  if (call.color_channels < 0 || call.feature_channels < 0 || call.color_channels + call.feature_channels > 1 << 20)
    refuse("%lld colours and %lld features", (long long)call.color_channels, (long long)call.feature_channels);
  if (call.count > 0 && call.colors == nullptr && call.color_channels != 0 &&
      (call.color_channels != 3 || (!dense && call.sh_dc == nullptr)))
    refuse("one of sh, sh_dc and colors is needed");
  if (dense) {
    g.sh_dc = numbers<S>(call.sh), g.sh_rest = g.sh_dc + 3;
    g.sh_dc_stride = g.sh_rest_stride = 3 * call.sh_rows;
  } else if (call.sh_dc != nullptr) {
    g.sh_dc = numbers<S>(call.sh_dc), g.sh_dc_stride = 3;
    if (call.sh_rest != nullptr) g.sh_rest = numbers<S>(call.sh_rest), g.sh_rest_stride = 3 * call.rest_rows;
  }
  g.sh_degree = call.sh_degree;
  g.colors = numbers<S>(call.colors), g.color_channels = int(call.color_channels);
  g.features = numbers<S>(call.features), g.feature_channels = int(call.feature_channels);
  return g;
}

template <class Call>
Channels channels_of(const Call& call) {
  const Channels channels{int(call.color_channels), (call.flags & kInverseDepth) != 0,
                          (call.flags & kAccumulatedDepth) != 0, int(call.feature_channels)};
  if (channels.total() < 1) refuse("there is no channel to draw");
  if ((call.flags & kSurfels) && channels.total() != 3) refuse("surfels have 3 colours, got %d channels", channels.total());
  return channels;
}

// Where gradients go.
template <class S, class Call>
Gradients<S> gradients_of(const Call& call, const Gaussians<S>& g) {
  Gradients<S> out{};
  out.means = numbers<S>(call.of_means), out.opacities = numbers<S>(call.of_opacities);
  out.scales = numbers<S>(call.of_scales), out.quats = numbers<S>(call.of_quats);
  out.cov3d = numbers<S>(call.of_cov3d), out.colors = numbers<S>(call.of_colors);
  out.features = numbers<S>(call.of_features), out.scale_factors = numbers<S>(call.of_scale_factors);
  out.grad2d = numbers<S>(call.of_grad2d), out.absgrad2d = numbers<S>(call.of_absgrad2d);
  if (call.of_sh != nullptr) {
    out.sh_dc = numbers<S>(call.of_sh), out.sh_dc_stride = out.sh_rest_stride = g.sh_dc_stride;
    if (call.sh_rows > 1) out.sh_rest = out.sh_dc + 3;
  } else {
    out.sh_dc = numbers<S>(call.of_sh_dc), out.sh_dc_stride = 3;
    out.sh_rest = numbers<S>(call.of_sh_rest), out.sh_rest_stride = g.sh_rest_stride;
  }
  return out;
}

}  // namespace sw
