// Colours of Gaussians that share SH coefficients, read from the codebook where they are evaluated.
//
//   shade_shared           colours [N][3]
//   shade_shared_backward  dL/dcolour -> the same without what the clamp stops; dL/dmean, dL/ddc
//   add_to_codebook        dL/dcolour -> dL/dcodebook: for each entry the sum over its users in their order
#pragma once

#include <splatwizard/dispatch.h>

#include "../shared_colors.h"

#define SW_DECLARE_KERNELS(arch)                                                                                      \
  namespace arch {                                                                                                    \
  using namespace sw;                                                                                                 \
  template <class S>                                                                                                  \
  void shade_shared(const SharedColors<S>& in, S* colors);                                                            \
  template <class S>                                                                                                  \
  void shade_shared_backward(const SharedColors<S>& in, const S* gradient, S* passed, S* means, S* dc);               \
  template <class S>                                                                                                  \
  void add_to_codebook(const SharedColors<S>& in, const int64_t* order, const int64_t* offsets, const S* passed,      \
                       S* codebook);                                                                                  \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_KERNELS)
#undef SW_DECLARE_KERNELS
