// TC-GS-style inference: log2 alpha of 32 pixels and 8 splats by two tensor-core products.
//
// Row of A: the monomials of a pixel about the tile's middle, multiples of 1/4 up to 57 and so exact as halves, twice.
// Column of B: a splat's coefficients, each as the sum of two halves: 22 bits. Sums are float32. Needs sm_80.
#include <cuda_fp16.h>

#include "segments.h"

namespace sw::cuda {
namespace {

__device__ __forceinline__ unsigned pair(float first, float second) {
  const __half2 both = __floats2half2_rn(first, second);
  return reinterpret_cast<const unsigned&>(both);
}

// d[0], d[1]: this lane's first pixel and two splats; d[2], d[3]: its second pixel. A's columns 8 to 15 repeat 0 to 7.
__device__ __forceinline__ void multiply(float (&d)[4], unsigned first, unsigned second, uint2 b) {
#if __CUDA_ARCH__ >= 800
  asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %4, %5}, {%6, %7}, "
      "{%8, %8, %8, %8};"
      : "=f"(d[0]), "=f"(d[1]), "=f"(d[2]), "=f"(d[3])
      : "r"(first), "r"(second), "r"(b.x), "r"(b.y), "f"(0.f));
#else
  __trap();  // declared for compute capability 8.0 and up
#endif
}

struct Tensor {
  struct __align__(16) Record {
    float red, green, blue, unused;
    uint2 column[kQuarters];  // coefficients 2q and 2q + 1: high halves, then what they lack

    __device__ __forceinline__ void set(const Polynomial& p, float red_, float green_, float blue_) {
      red = red_, green = green_, blue = blue_;
#pragma unroll
      for (int q = 0; q < 3; ++q) {
        const float a = p.k[2 * q], b = p.k[2 * q + 1];
        column[q] = make_uint2(pair(a, b), pair(a - __half2float(__float2half_rn(a)),
                                                b - __half2float(__float2half_rn(b))));
      }
      column[3] = make_uint2(0, 0);
    }
  };

  unsigned rows[kColumn];  // this lane's two columns of A, for its four pixels

  __device__ __forceinline__ Tensor(float x, float y) {
    const int q = lane_index() % kQuarters;
#pragma unroll
    for (int j = 0; j < kColumn; ++j) {
      const float at = y + float(j);
      const float first = q == 0 ? 1.f : q == 1 ? at : x * at, second = q == 0 ? x : q == 1 ? x * x : at * at;
      rows[j] = q == 3 ? 0 : pair(first, second);
    }
  }

  __device__ __forceinline__ void walk(const Record* records, const uint16_t* list, int steps, Segment& to) const {
    const auto at = [&](unsigned offset) -> const Record& {
      return *reinterpret_cast<const Record*>(reinterpret_cast<const char*>(records) + offset);
    };
    const int group = lane_index() / kQuarters, q = lane_index() % kQuarters;
    const uint16_t* own = list + q * 2 * steps;                             // what this lane composites
    const uint16_t* loaded = list + group / 2 * 2 * steps + group % 2;      // what it loads for B: column `group`
    for (int i = 0; i < steps; ++i) {
      const uint2 b = at(loaded[2 * i]).column[q];
      const unsigned two = *reinterpret_cast<const unsigned*>(own + 2 * i);
      float upper[4], lower[4];
      multiply(upper, rows[0], rows[1], b);
      multiply(lower, rows[2], rows[3], b);
#pragma unroll
      for (int half = 0; half < 2; ++half) {
        const float4 c = *reinterpret_cast<const float4*>(&at(half == 0 ? two & 0xffffu : two >> 16));
        to.add(0, upper[half], c.x, c.y, c.z);
        to.add(1, upper[2 + half], c.x, c.y, c.z);
        to.add(2, lower[half], c.x, c.y, c.z);
        to.add(3, lower[2 + half], c.x, c.y, c.z);
      }
    }
  }
};

}  // namespace

void blend_tcgs(const View<float>& view, const Splats& splats, const TileLists& lists, const Image& image,
                uint8_t* bytes, cudaStream_t stream) {
  blend_fast<Tensor>(view, splats, lists, image, bytes, stream);
}

}  // namespace sw::cuda
