// The kernels of HAC on a GPU: what C and Python call.
#pragma once
#include "../face.h"

SW_OPERATION(sw_hac_cuda, mixture_bits);
SW_OPERATION(sw_hac_cuda, channel_inputs);
SW_OPERATION(sw_hac_cuda, channel_slopes);
