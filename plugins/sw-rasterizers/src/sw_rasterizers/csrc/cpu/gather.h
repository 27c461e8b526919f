// Rows of arrays of structures into packs, one Gaussian a lane, and back.
#pragma once

#include "../common.h"

namespace SW_ARCH {
using namespace sw;

template <class V, int kFields>
SW_HD void gather_rows(const Scalar<V>* base, int64_t stride, const int32_t* rows, V* out) {
  constexpr int L = lanes_of<V>;
  alignas(64) Scalar<V> buffer[kFields][L];
  for (int i = 0; i < L; ++i) {
    const Scalar<V>* row = base + rows[i] * stride;
    for (int k = 0; k < kFields; ++k) buffer[k][i] = row[k];
  }
  for (int k = 0; k < kFields; ++k) out[k] = load<V>(buffer[k]);
}

// The rows first, first + 1, ... of one pack; the last one is repeated beyond `end`.
template <class V>
SW_HD void lane_rows(int64_t first, int64_t end, int32_t* rows) {
  for (int i = 0; i < lanes_of<V>; ++i) rows[i] = int32_t(first + i < end ? first + i : end - 1);
}

// Long rows: blocks of L fields are loaded whole and transposed in registers. `out` has room for a multiple of L.
template <class V>
SW_HD void gather_long_rows(const Scalar<V>* base, int64_t stride, const int32_t* rows, int fields, V* out) {
  constexpr int L = lanes_of<V>;
  for (int first = 0; first < fields; first += L) {
    V* block = out + first;
    if (fields - first >= L) {
      for (int i = 0; i < L; ++i) block[i] = load<V>(base + rows[i] * stride + first);
    } else {
      for (int i = 0; i < L; ++i) {  // no reading beyond the row's end
        block[i] = V{};
        __builtin_memcpy(&block[i], base + rows[i] * stride + first, sizeof(Scalar<V>) * (fields - first));
      }
    }
    transpose(block);
  }
}

// The inverse: the first `count` rows are written, `values` (room for a multiple of L) is overwritten.
template <class V>
SW_HD void scatter_long_rows(V* values, int fields, Scalar<V>* base, int64_t stride, const int32_t* rows, int count) {
  constexpr int L = lanes_of<V>;
  for (int first = 0; first < fields; first += L) {
    V* block = values + first;
    transpose(block);
    const size_t bytes = sizeof(Scalar<V>) * (fields - first < L ? fields - first : L);
    for (int i = 0; i < count; ++i) __builtin_memcpy(base + rows[i] * stride + first, &block[i], bytes);
  }
}

// Only the first `count` lanes are written.
template <class V, int kFields>
SW_HD void scatter_rows(const V* values, Scalar<V>* base, int64_t stride, const int32_t* rows, int count) {
  constexpr int L = lanes_of<V>;
  alignas(64) Scalar<V> buffer[kFields][L];
  for (int k = 0; k < kFields; ++k) store(buffer[k], values[k]);
  for (int i = 0; i < count; ++i) {
    Scalar<V>* row = base + rows[i] * stride;
    for (int k = 0; k < kFields; ++k) row[k] = buffer[k][i];
  }
}

}  // namespace SW_ARCH
