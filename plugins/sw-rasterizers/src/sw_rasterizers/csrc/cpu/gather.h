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

template <class V>
SW_HD void gather_rows(const Scalar<V>* base, int64_t stride, const int32_t* rows, int fields, V* out) {
  constexpr int L = lanes_of<V>;
  for (int i = 0; i < L; ++i) {
    const Scalar<V>* row = base + rows[i] * stride;
    Scalar<V>* to = reinterpret_cast<Scalar<V>*>(out) + i;
    for (int k = 0; k < fields; ++k) to[k * L] = row[k];
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
