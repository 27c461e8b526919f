// The kernels of wisp's training on a GPU: what C and Python call.
#pragma once
#include "../face.h"

SW_OPERATION(sw_wisp_cuda, eight_bits);
SW_OPERATION(sw_wisp_cuda, draw);
SW_OPERATION(sw_wisp_cuda, draw_backward);
SW_OPERATION(sw_wisp_cuda, bits);
SW_OPERATION(sw_wisp_cuda, bits_backward);
SW_OPERATION(sw_wisp_cuda, splats);
SW_OPERATION(sw_wisp_cuda, splats_backward);
