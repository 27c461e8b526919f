// Forecasts of a walk through packets (sw_wisp.packets), and values under them.
#include <algorithm>

#include "ties_face.h"

namespace {

using namespace splatwizard;

constexpr int64_t NUMBERS = 22, UNIT = 4096, LAST_TABLE = 63, LIMIT = 1 << 20, LAST_MULTIPLIER = 127;

template <class Call>
void check_rows(const Call& a) {
  if (a.start < 0 || a.columns < 0 || a.start + a.columns > NUMBERS) refuse("there are no such columns");
  const int64_t last = a.first + (a.n - 1) * a.step;
  if (a.n > 0 && (a.first < 0 || a.step < 1 || last >= a.splats)) refuse("row %lld is none", (long long)last);
}

}  // namespace

SW_OPERATION(sw_wisp_exact, forecasts) {
  return guarded(call, [&](const Parallel& parallel) {
    const auto& a = *call;
    int64_t steps = 0;
    for (int64_t c = 0; c < a.columns; ++c) {
      if (a.step_of[c] < 0) refuse("column %lld has no step output", (long long)c);
      steps = std::max(steps, a.step_of[c] + 1);
    }
    if (a.start < 0 || a.start + a.columns > a.seen || a.given < 2 * a.columns + steps)
      refuse("there are no such columns");
    parallel(a.n, 1024, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        const int64_t* const before = a.features + a.seen * i + a.start;
        const int64_t* const out = a.outputs + a.given * i;
        for (int64_t c = 0; c < a.columns; ++c) {
          const int64_t at = a.columns * i + c;
          a.mean[at] = before[c] + out[c];
          a.scale[at] = out[a.columns + c];
          const int64_t place = (out[2 * a.columns + a.step_of[c]] + (1 << 15)) >> 9;
          a.multiplier[at] = a.multipliers ? a.multipliers[std::clamp<int64_t>(place, 0, LAST_MULTIPLIER)] : UNIT;
        }
      }
    });
  });
}

SW_OPERATION(sw_wisp_exact, kept) {
  return guarded(call, [&](const Parallel& parallel) {
    const auto& a = *call;
    check_rows(a);
    if (a.begin < 0 || a.begin + a.columns > a.width) refuse("there are no such columns");
    parallel(a.n, 1024, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i)
        for (int64_t c = 0; c < a.columns; ++c) {
          const int64_t given = a.width * i + a.begin + c, found = a.columns * i + c;
          const int64_t to = (a.first + i * a.step) * NUMBERS + a.start + c;
          int64_t mean = a.mean[given], scale = a.scale[given];
          if (a.moved != nullptr) {
            mean += a.moved[found];
            scale += a.moved[a.n * a.columns + found];
          }
          scale = std::clamp<int64_t>(scale, 0, LAST_TABLE * UNIT);
          a.to_mean[to] = static_cast<int32_t>(std::clamp<int64_t>(mean, -LIMIT, LIMIT));
          a.to_scale[to] = static_cast<int32_t>(scale);
          a.to_multiplier[to] = static_cast<int32_t>(a.multiplier[given]);
          const int64_t table = (scale - a.lower + UNIT / 2) >> 12;
          a.tables[found] = static_cast<uint8_t>(std::clamp<int64_t>(table, 0, LAST_TABLE));
        }
    });
  });
}

SW_OPERATION(sw_wisp_exact, values) {
  return guarded(call, [&](const Parallel& parallel) {
    const auto& a = *call;
    check_rows(a);
    parallel(a.n, 1024, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i)
        for (int64_t c = 0; c < a.columns; ++c) {
          const int64_t from = (a.first + i * a.step) * NUMBERS + a.start + c;
          a.found[a.columns * i + c] = a.mean[from] + static_cast<int64_t>(a.index[from]) * a.multiplier[from];
        }
    });
  });
}
