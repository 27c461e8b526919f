// Features of places on planes, and their gradient by the planes, on the CPU.
#include <atomic>
#include <cstring>

#include "kernels.h"

namespace SW_ARCH {

using namespace sw_sites;

namespace {

constexpr int TOGETHER = 8;  // channels that are one vector
typedef float Vector __attribute__((vector_size(4 * TOGETHER)));

// body(its type, first channel) for all channels: vectors, then what is left one by one.
template <class T>
struct Kind {
  using type = T;
};
template <class Body>
void for_channels(int channels, const Body& body) {
  int c = 0;
  for (; c + TOGETHER <= channels; c += TOGETHER) body(Kind<Vector>(), c);
  for (; c < channels; ++c) body(Kind<float>(), c);
}

}  // namespace

bool sites_lookup(const Sites& at, const float* const* tables, float* found, const splatwizard::Parallel& parallel) {
  const int width = kPlanes * at.channels;
  std::atomic<bool> fits{true};
  parallel(at.count, 128, [&](int64_t begin, int64_t end) {
    for (int64_t n = begin; n < end; ++n)
      for (int scale = 0; scale < at.scales; ++scale)
        for (int plane = 0; plane < kPlanes; ++plane) {
          const int64_t place = ((n * at.scales + scale) * kPlanes + plane) * kCorners;
          const float* rows[kCorners];
          for (int corner = 0; corner < kCorners; ++corner) {
            const int32_t cell = at.cells[place + corner];
            if (cell < 0 || cell >= at.rows[scale]) return fits.store(false);
            rows[corner] = tables[scale] + int64_t(cell) * at.channels;
          }
          const float* w = at.weights + place;
          float* to = found + (n * at.scales + scale) * width + plane * at.channels;
          for (int c = 0; c < at.channels; ++c) {
            const float sum = w[0] * rows[0][c] + w[1] * rows[1][c] + w[2] * rows[2][c] + w[3] * rows[3][c];
            to[c] = scale == 0 ? sum : sum + to[c - width];
          }
        }
  });
  return fits;
}

void sites_backward(const Sites& at, const float* gradient, float* const* tables,
                    const splatwizard::Parallel& parallel) {
  const int width = kPlanes * at.channels;
  parallel(at.scales * kPlanes, 1, [&](int64_t begin, int64_t end) {
    for (int64_t task = begin; task < end; ++task) {
      const int scale = int(task) / kPlanes, plane = int(task) % kPlanes;
      for (int64_t n = 0; n < at.count; ++n) {
        const int64_t place = ((n * at.scales + scale) * kPlanes + plane) * kCorners;
        const float* w = at.weights + place;
        const float* from = gradient + (n * at.scales + scale) * width + plane * at.channels;
        float* rows[kCorners];
        for (int corner = 0; corner < kCorners; ++corner)
          rows[corner] = tables[scale] + int64_t(at.cells[place + corner]) * at.channels;
        for_channels(at.channels, [&](auto kind, int c) {
          typename decltype(kind)::type total{}, part;  // a plane is in its own feature and all finer ones
          for (int finer = at.scales - 1 - scale; finer >= 0; --finer) {
            std::memcpy(&part, from + finer * width + c, sizeof part);
            total += part;
          }
          for (int corner = 0; corner < kCorners; ++corner) {  // in turn: cells of a place may be the same
            std::memcpy(&part, rows[corner] + c, sizeof part);
            part += w[corner] * total;
            std::memcpy(rows[corner] + c, &part, sizeof part);
          }
        });
      }
    }
  });
}

}  // namespace SW_ARCH
