// Features of places in integers: a binary hash grid (sw_codecs.context.hash_grid) and planes
// (sw_cat_3dgs.triplane).
#include "kernels.h"
#include "rans.h"
#include "vectors.h"

namespace SW_ARCH {

using namespace splatwizard;

namespace {

constexpr uint64_t POSITION_TOP = 65535;
constexpr int64_t PRIMES[3] = {1, 2654435761, 805459861};

typedef double Four __attribute__((vector_size(32)));

// 1 where a bit is set, for all sets of four bits.
struct Bits {
  Four of[16];
  Bits() {
    for (int set = 0; set < 16; ++set)
      for (int f = 0; f < 4; ++f) of[set][f] = set >> f & 1;
  }
};

// Features of one level at one place: cell, and part of it in 1/4096, of each axis.
template <int D, class Out>
void level_features(const GridArgs& a, const Bits& bits, int64_t level, const int64_t* cell, const int64_t* part,
                    Out* out) {
  const bool dense = level < a.dense;
  const int64_t mask = (int64_t{1} << a.log2_size) - 1, last = a.last[level];
  uint32_t place[D][2];
  double weight[D][2];
  int64_t stride = 1;
  for (int d = 0; d < D; ++d) {
    const int64_t ends[2] = {cell[d] < last ? cell[d] : last, cell[d] + 1 < last ? cell[d] + 1 : last};
    for (int e = 0; e < 2; ++e)
      place[d][e] = static_cast<uint32_t>(dense ? ends[e] * stride : (ends[e] * PRIMES[d]) & mask);
    weight[d][0] = static_cast<double>(cell[d] > 0 ? 4096 - part[d] : 0);
    weight[d][1] = static_cast<double>(cell[d] + 1 < last ? part[d] : 0);
    stride *= last + 1;
  }
  double total = 0, share[1 << D];  // integers below 2^37: exact
  uint16_t signs[1 << D];
  const uint16_t* table = a.signs + a.start[level];
  for (int corner = 0; corner < 1 << D; ++corner) {
    double w = weight[0][corner & 1];
    uint32_t entry = place[0][corner & 1];
    for (int d = 1; d < D; ++d) {
      const int e = corner >> d & 1;
      w *= weight[d][e];
      entry = dense ? entry + place[d][e] : entry ^ place[d][e];
    }
    share[corner] = w;
    signs[corner] = table[entry];
    total += w;
  }
  const double divisor = total > 0 ? total : 1;
  for (int f = 0; f < a.features; f += 4) {
    Four positive{};
    for (int corner = 0; corner < 1 << D; ++corner)
      positive += bits.of[signs[corner] >> f & 15] * Four{share[corner], share[corner], share[corner], share[corner]};
    // At most 2^12 in magnitude, of integers below 2^49: the rounded quotient never reaches the next integer.
    const Four dividend = (2 * positive - Four{total, total, total, total}) * 4096.0;
    const Four quotient = dividend / Four{divisor, divisor, divisor, divisor};
    for (int i = 0; i < 4 && f + i < a.features; ++i) {
      const auto whole = static_cast<int32_t>(quotient[i]);
      out[f + i] = static_cast<Out>(whole - (static_cast<double>(whole) > quotient[i]));
    }
  }
}

template <int D, class Out>
void grid_rows(const GridArgs& a, const Bits& bits, int64_t begin, int64_t end, Out* first) {
  for (int64_t row = begin; row < end; ++row) {
    Out* out = first + row * a.stride;
    int64_t code[D], cell[D], part[D];
    bool inside = true;
    for (int d = 0; d < D; ++d) {
      code[d] = a.codes[3 * row + a.axes[d]];
      inside &= code[d] >= 0 && code[d] <= static_cast<int64_t>(POSITION_TOP);
    }
    for (int64_t level = 0; level < a.levels; ++level) {
      if (!inside) {
        for (int f = 0; f < a.features; ++f) out[a.column[level] + f] = 0;
        continue;
      }
      for (int d = 0; d < D; ++d) {
        const uint64_t at = static_cast<uint64_t>(code[d] * (a.last[level] - 1)) << 12;
        const auto place = static_cast<int64_t>(at / POSITION_TOP) + 2048;
        cell[d] = place >> 12;
        part[d] = place & 4095;
      }
      level_features<D, Out>(a, bits, level, cell, part, out + a.column[level]);
    }
  }
}

}  // namespace

void grid_features(const GridArgs& a, const Parallel& parallel) {
  static const Bits bits;
  parallel(a.rows, 256, [&](int64_t begin, int64_t end) {
    if (a.short_out != nullptr)
      a.dimensions == 3 ? grid_rows<3>(a, bits, begin, end, a.short_out)
                        : grid_rows<2>(a, bits, begin, end, a.short_out);
    else
      a.dimensions == 3 ? grid_rows<3>(a, bits, begin, end, a.out) : grid_rows<2>(a, bits, begin, end, a.out);
  });
}

void triplane_features(const TriplaneArgs& a, const Parallel& parallel) {
  constexpr int PAIRS[3][2] = {{0, 1}, {0, 2}, {1, 2}};
  const int64_t width = 3 * a.channels;
  parallel(a.rows, 128, [&](int64_t begin, int64_t end) {
    Scratch<double> total(width);
    for (int64_t row = begin; row < end; ++row) {
      for (int64_t i = 0; i < width; ++i) total[i] = 0;
      for (int64_t scale = 0; scale < a.scales; ++scale) {
        const int64_t size = a.size[scale];
        int64_t cell[3], following[3], part[3];
        for (int d = 0; d < 3; ++d) {
          const int64_t u = a.places[3 * row + d], place = u < 0 ? 0 : u > 1 << 20 ? 1 << 20 : u;
          const int64_t at = (place * (size - 1)) >> 8, top = size >= 2 ? size - 2 : 0;
          cell[d] = at >> 12 < top ? at >> 12 : top;
          part[d] = at - (cell[d] << 12);
          following[d] = cell[d] + 1 < size ? cell[d] + 1 : size - 1;
        }
        int64_t* out = a.out + (row * a.scales + scale) * width;
        for (int pair = 0; pair < 3; ++pair) {
          const int across = PAIRS[pair][0], down = PAIRS[pair][1];
          const int32_t* plane = a.planes[scale] + pair * size * size * a.channels;
          const int32_t* __restrict left_above = plane + (cell[down] * size + cell[across]) * a.channels;
          const int32_t* __restrict right_above = plane + (cell[down] * size + following[across]) * a.channels;
          const int32_t* __restrict left_below = plane + (following[down] * size + cell[across]) * a.channels;
          const int32_t* __restrict right_below = plane + (following[down] * size + following[across]) * a.channels;
          const auto x = static_cast<double>(part[across]), y = static_cast<double>(part[down]);
          const double w00 = (4096 - y) * (4096 - x), w01 = (4096 - y) * x, w10 = y * (4096 - x), w11 = y * x;
          double* __restrict sum = total.data + pair * a.channels;
          for (int64_t c = 0; c < a.channels; ++c)
            sum[c] += w00 * left_above[c] + w01 * right_above[c] + w10 * left_below[c] + w11 * right_below[c];
        }
        int64_t i = 0;
        for (; i + LANES <= width; i += LANES)
          store_integers(out + i, floor_of(load(total.data + i) * (1.0 / 65536)));
        for (; i < width; ++i) {
          const double x = total[i] * (1.0 / 65536);
          const auto whole = static_cast<int64_t>(x);
          out[i] = whole - (static_cast<double>(whole) > x);
        }
      }
    }
  });
}

}  // namespace SW_ARCH
