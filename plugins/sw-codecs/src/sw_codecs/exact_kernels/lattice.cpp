// Which table codes each number, and about which integer (sw_codecs.entropy.lattice).
#include "lattice.h"

#include <atomic>

namespace SW_ARCH {

using namespace splatwizard;

namespace {

void copy(const int32_t* centre, const int16_t* number, int64_t n, int32_t* to_centre, int16_t* to_number) {
  std::memcpy(to_centre, centre, sizeof(int32_t) * static_cast<size_t>(n));
  std::memcpy(to_number, number, sizeof(int16_t) * static_cast<size_t>(n));
}

}  // namespace

int32_t lattice(const LatticeArgs& a, const Parallel& parallel) {
  const Levels levels(a.thresholds);
  std::atomic<int32_t> status{FINE};
  parallel(a.rows, 1024, [&](int64_t begin, int64_t end) {
    double mean[COLUMNS], scale[COLUMNS];
    int32_t centre[COLUMNS], found = FINE;
    int16_t number[COLUMNS];
    for (int64_t row = begin; row < end; ++row) {
      const int64_t m = a.multiplier[row * a.multiplier_stride];
      if (m < 64 || m > 16384) {
        found = PARAMETER_WRONG;
        continue;
      }
      const uint8_t* present = a.present == nullptr ? nullptr : a.present + row * a.columns;
      int64_t at = present == nullptr ? row * a.columns : a.start[row];
      for (int64_t c = 0; c < a.columns; c += COLUMNS) {
        const int64_t n = a.columns - c < COLUMNS ? a.columns - c : COLUMNS;
        if (!take_integers(a.mean + row * a.mean_stride + c, n, mean) || !take_integers(a.scale + row * a.scale_stride + c, n, scale))
          found = PARAMETER_WRONG;
        else if (columns_of(levels, mean, scale, m, n, centre, number))
          found = BEYOND_LIMIT;
        const int64_t kept = present == nullptr ? n : keep_present(present + c, n, centre, number);
        copy(centre, number, kept, a.centre + at, a.number + at);
        at += kept;
      }
    }
    int32_t fine = FINE;
    if (found != FINE) status.compare_exchange_strong(fine, found);
  });
  return status;
}

void present_rows(const PresentArgs& a, const Parallel& parallel) {
  parallel(a.rows, 1024, [&](int64_t begin, int64_t end) {
    int32_t centre[COLUMNS];
    int16_t number[COLUMNS];
    for (int64_t row = begin; row < end; ++row) {
      int64_t at = a.start[row];
      for (int64_t c = 0; c < a.columns; c += COLUMNS) {
        const int64_t from = row * a.columns + c, n = a.columns - c < COLUMNS ? a.columns - c : COLUMNS;
        copy(a.centre + from, a.number + from, n, centre, number);
        const int64_t kept = keep_present(a.present + from, n, centre, number);
        copy(centre, number, kept, a.to_centre + at, a.to_number + at);
        at += kept;
      }
    }
  });
}

}  // namespace SW_ARCH
