// The kernels of the CPU, declared once for every instruction set that they are compiled for.
//
//   spawn            the Gaussians of `from.drawn`
//   spawn_backward   gradients of all anchors, which hold zeros before; sums of an anchor in the order of its Gaussians,
//                    so that they are the same for any number of threads
#pragma once

#include <splatwizard/dispatch.h>
#include <splatwizard/parallel.h>

#include "spawn.h"

#define SW_DECLARE_SPAWN(arch)                                                                                  \
  namespace arch {                                                                                              \
  void spawn(const sw_anchors::Anchors& from, const sw_anchors::Gaussians& to,                                  \
             const splatwizard::Parallel& parallel);                                                            \
  void spawn_backward(const sw_anchors::Anchors& from, const sw_anchors::Gaussians& slope,                      \
                      const sw_anchors::Gradients& to, const splatwizard::Parallel& parallel);                  \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_SPAWN)
#undef SW_DECLARE_SPAWN
