// Features of places on planes, and their gradient by the planes, on the CPU.
#include <algorithm>
#include <atomic>

#include "kernels.h"

namespace SW_ARCH {

using namespace sw_sites;

namespace {

constexpr int TOGETHER = 32;  // channels whose gradients are summed on the stack

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
        for (int first = 0; first < at.channels; first += TOGETHER) {
          const int some = std::min(TOGETHER, at.channels - first);
          float total[TOGETHER] = {};  // a plane is in its own feature and all finer ones
          for (int finer = at.scales - 1 - scale; finer >= 0; --finer)
            for (int c = 0; c < some; ++c) total[c] += from[finer * width + first + c];
          // One after the other: cells of a place may be the same.
          for (int corner = 0; corner < kCorners; ++corner)
            for (int c = 0; c < some; ++c) rows[corner][first + c] += w[corner] * total[c];
        }
      }
    }
  });
}

}  // namespace SW_ARCH
