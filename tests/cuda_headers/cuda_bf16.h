#pragma once
#include <cuda_runtime_api.h>

struct __nv_bfloat162 {
  uint16_t x, y;
};
inline __nv_bfloat162 __floats2bfloat162_rn(float x, float y) {
  const auto rounded = [](float number) {
    const unsigned bits = cuda_on_cpu::bits_as<unsigned>(number);
    return uint16_t((bits + 0x7fffu + (bits >> 16 & 1)) >> 16);
  };
  return {rounded(x), rounded(y)};
}
