// The arguments of the CUDA ops of surfels, checked.
#pragma once

#include <array>
#include <vector>

#include "binding.h"

namespace sw {

// clang-format off
enum WantedSurfel {  // order of the gradients asked for and returned
  kSurfelMeans, kSurfelOpacities, kSurfelScales, kSurfelQuats, kSurfelSh, kSurfelShDc, kSurfelShRest, kSurfelColors,
  kSurfelGrad2d, kSurfelWanted
};
// clang-format on

inline const OptionalTensor kNone;

struct SurfelInputs : Inputs {
  SurfelInputs(const Tensor& means, const Tensor& opacities, const OptionalTensor& scales, const OptionalTensor& quats,
               const OptionalTensor& sh, const OptionalTensor& sh_dc, const OptionalTensor& sh_rest,
               const OptionalTensor& colors, const OptionalTensor& visible, const OptionalTensor& background,
               int64_t sh_degree, double scale_modifier, int64_t flags)
      : Inputs{means,  opacities, scales,  quats,      kNone,     sh,             sh_dc, sh_rest,
               colors, kNone,     visible, background, sh_degree, scale_modifier, 0,     flags,
               2} {}

  void check_all(at::ArrayRef<double> camera, int64_t width, int64_t height) const {
    check();
    TORCH_CHECK(channels().colors == 3, "sw_rasterizers: surfels have 3 colour channels, got ", channels().colors);
    TORCH_CHECK(camera.size() == 18 && width > 0 && height > 0, "sw_rasterizers: malformed camera");
  }
};

// The gradients that are asked for; the others are empty.
struct SurfelGradients {
  std::vector<Tensor> tensors;
  const Inputs& in;

  template <class Make>
  SurfelGradients(const Inputs& in, const std::array<bool, kSurfelWanted>& wanted, const Make& make)
      : tensors(kSurfelWanted), in(in) {
    const auto put = [&](int which, const OptionalTensor& like) {
      tensors[size_t(which)] = make(wanted[size_t(which)] && like.has_value() ? like->sizes() : at::IntArrayRef{0});
    };
    put(kSurfelMeans, in.means), put(kSurfelOpacities, in.opacities);
    put(kSurfelScales, in.scales), put(kSurfelQuats, in.quats);
    put(kSurfelSh, in.sh), put(kSurfelShDc, in.sh_dc), put(kSurfelShRest, in.sh_rest), put(kSurfelColors, in.colors);
    tensors[kSurfelGrad2d] = make({wanted[kSurfelGrad2d] ? in.means.size(0) : 0, 2});
  }

  template <class S>
  Gradients<S> pointers() const {
    const auto g = in.gaussians<S>();
    const auto at = [&](int which) { return data<S>(tensors[size_t(which)]); };
    Gradients<S> out{};
    out.means = at(kSurfelMeans), out.opacities = at(kSurfelOpacities);
    out.scales = at(kSurfelScales), out.quats = at(kSurfelQuats), out.colors = at(kSurfelColors);
    out.grad2d = at(kSurfelGrad2d);
    if (S* sh = at(kSurfelSh)) {
      out.sh_dc = sh, out.sh_dc_stride = out.sh_rest_stride = g.sh_dc_stride;
      if (in.sh->size(1) > 1) out.sh_rest = sh + 3;
    } else {
      out.sh_dc = at(kSurfelShDc), out.sh_dc_stride = 3;
      out.sh_rest = at(kSurfelShRest), out.sh_rest_stride = g.sh_rest_stride;
    }
    return out;
  }
};

}  // namespace sw
