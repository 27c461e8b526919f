// Ties (sw_wisp.ties): sums of integers below 2^53, and shifts that round down as floor does.
#include <algorithm>

#include "ties_face.h"

namespace {

using namespace splatwizard;

constexpr int64_t NUMBERS = 22, UNIT = 4096, LAST_TABLE = 63, LIMIT = 1 << 20, LARGEST_SIZE = 4 * UNIT;

}  // namespace

SW_OPERATION(sw_wisp_exact, moved) {
  return guarded(call, [&](const Parallel& parallel) {
    const auto& a = *call;
    if (a.before < 1 || a.start < 0 || a.start + a.before > NUMBERS) refuse("there are no such columns");
    const int64_t last = a.first + (a.n - 1) * a.step;
    if (a.n > 0 && (a.first < 0 || a.step < 1 || last >= a.splats)) refuse("row %lld is none", (long long)last);
    parallel(a.n, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        int64_t known[2][NUMBERS];  // residuals and sizes
        const int64_t at = (a.first + i * a.step) * NUMBERS + a.start;
        for (int64_t j = 0; j < a.before; ++j) {
          const int64_t k = a.index[at + j], residual = k * a.multiplier[at + j];
          const int64_t table = std::clamp<int64_t>((a.scale[at + j] + UNIT / 2) >> 12, 0, LAST_TABLE);
          known[0][j] = std::clamp(residual, -LIMIT, LIMIT);
          known[1][j] = std::min((k < 0 ? -k : k) * a.sizes[table], LARGEST_SIZE);
        }
        for (int64_t half = 0; half < 2; ++half)
          for (int64_t c = 0; c < a.columns; ++c) {
            const int64_t* const weights = a.weights + (half * a.columns + c) * a.before;
            int64_t sum = 0;
            for (int64_t j = 0; j < a.before; ++j) sum += known[half][j] * weights[j];
            a.moved[(half * a.n + i) * a.columns + c] = sum >> 12;
          }
      }
    });
  });
}
