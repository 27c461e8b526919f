// The kernels of the CPU, declared once for every instruction set that they are compiled for.
//
//   mixture_bits     bits of a sample of anchors from the outputs of networks, of features perhaps under two Gaussians,
//                    and their derivatives
//   channel_inputs   inputs [count, inputs] of the networks of channels; channel_slopes: from the derivatives of the bits
//                    those of what follows, by x and outputs
#pragma once

#include <splatwizard/dispatch.h>
#include <splatwizard/parallel.h>

#include "mixture.h"

#define SW_DECLARE_HAC(arch)                                                                                    \
  namespace arch {                                                                                              \
  void mixture_bits(const sw_hac::Mixture& from, const sw_hac::MixtureSlopes& to,                               \
                    const splatwizard::Parallel& parallel);                                                     \
  void channel_inputs(const sw_hac::Channels& of, const float* x, const float* outputs, float* to,              \
                      const splatwizard::Parallel& parallel);                                                   \
  void channel_slopes(const sw_hac::Channels& of, const sw_hac::ChannelSlopes& by, float* to_x,                 \
                      float* to_outputs, const splatwizard::Parallel& parallel);                                \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_HAC)
#undef SW_DECLARE_HAC
