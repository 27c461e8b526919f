// The kernels of running means, declared once for every instruction set that they are compiled for. All numbers are
// whole and below 2^53: the results depend on no order, no number of threads and no instruction set.
#pragma once
#include <splatwizard/dispatch.h>
#include <splatwizard/parallel.h>

#include "face.h"

// `pyramid_features` in two, on one thread: means [cells, 44] of all cells around some splats, and what splats among
// those see of them, [n, stride].
#define SW_DECLARE_WISP(arch)                                                                     \
  namespace arch {                                                                                \
  void pyramid_features(const pyramid_features_call&, const splatwizard::Parallel&);              \
  void pyramid_means(const pyramid_features_call&, int32_t* means);                               \
  void pyramid_seen(const pyramid_features_call&, const int32_t* means, const int64_t* rows,      \
                    int64_t n, int64_t stride, int32_t* found);                                   \
  void pyramid_add(const pyramid_add_call&, const splatwizard::Parallel&);                        \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_WISP)
