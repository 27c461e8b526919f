// FlashGS-style inference: log2 alpha of four pixels of a column by Horner's rule, opacity folded in, one exponential.
#include "segments.h"

namespace sw::cuda {
namespace {

struct Flash {
  struct __align__(16) Record {
    float4 low, high;  // 1, x, y, x^2; xy, y^2, red, green
    float blue;

    __device__ __forceinline__ void set(const Polynomial& p, float red, float green, float blue_) {
      low = make_float4(p.k[0], p.k[1], p.k[2], p.k[3]);
      high = make_float4(p.k[4], p.k[5], red, green);
      blue = blue_;
    }
  };

  float x, y;  // first pixel of the column, from the tile's middle

  __device__ __forceinline__ Flash(float x_, float y_) : x(x_), y(y_) {}

  __device__ __forceinline__ void walk(const Record* records, const uint16_t* list, int steps, Segment& to) const {
    const uint16_t* own = list + lane_index() % kQuarters * 2 * steps;
    for (int i = 0; i < steps; ++i) {
      const unsigned two = *reinterpret_cast<const unsigned*>(own + 2 * i);
#pragma unroll
      for (int half = 0; half < 2; ++half) {
        const auto& r = *reinterpret_cast<const Record*>(reinterpret_cast<const char*>(records) +
                                                         (half == 0 ? two & 0xffffu : two >> 16));
        const float4 low = r.low, high = r.high;
        const float blue = r.blue, level = (low.w * x + low.y) * x + low.x, slope = high.x * x + low.z;
#pragma unroll
        for (int j = 0; j < kColumn; ++j) {
          const float at = y + float(j);
          to.add(j, (high.y * at + slope) * at + level, high.z, high.w, blue);
        }
      }
    }
  }
};

}  // namespace

void blend_flash(const View<float>& view, const Splats& splats, const TileLists& lists, const Image& image,
                 uint8_t* bytes, cudaStream_t stream) {
  blend_fast<Flash>(view, splats, lists, image, bytes, stream);
}

}  // namespace sw::cuda
