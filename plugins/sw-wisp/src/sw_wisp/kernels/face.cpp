#include "calls.h"
#include "cpu.h"

#define SW_WISP_OPERATION(operation)                                                       \
  SW_OPERATION(sw_wisp, operation) {                                                       \
    return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {         \
      SW_SELECT(operation)(sw_wisp::of_call(*call), parallel);                             \
    });                                                                                    \
  }

SW_WISP_OPERATION(eight_bits)
SW_WISP_OPERATION(draw)
SW_WISP_OPERATION(draw_backward)
SW_WISP_OPERATION(bits)
SW_WISP_OPERATION(bits_backward)
SW_WISP_OPERATION(splats)
SW_WISP_OPERATION(splats_backward)
