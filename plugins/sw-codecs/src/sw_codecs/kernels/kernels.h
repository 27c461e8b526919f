// The kernels of the CPU, declared once for every instruction set that they are compiled for.
//
//   grid_lookup    x [n][axes] -> found [n][levels][features]
//   grid_backward  dL/dfound -> table [entries][features], which holds zeros before: a level by one thread, its points
//                  in their order, so that sums are the same for any number of threads
//   signs_lookup   as grid_lookup, of the signs of a table, whose `axes` axes are some of the `columns` of x; `found`
//                  and dL/dfound are the first of levels * features columns of rows that are `row` long
//   sites_lookup   features [count][scales * 3 * channels] from a table [rows][channels] of each scale -> whether all
//                  cells were within; sites_backward adds to such tables, a plane by one thread, places in their order
//   huffman_decode codes of `n` symbols, bits of a byte from the lowest one -> whether the bytes sufficed.
//                  counts [trees][size], size >= 2; index [n] below trees. Source: docs/bitstream.md, Huffman codes
//   nearest_entries rows [n][dim], entries [size][dim], size > 0 -> index [n] of the nearest entry; returns the share
//                  0..1 of the distances that were computed. Of values that are not finite an index is some entry's
#pragma once

#include <splatwizard/dispatch.h>
#include <splatwizard/parallel.h>

#include "grid.h"
#include "sites.h"

#define SW_DECLARE_GRID(arch)                                                                                       \
  namespace arch {                                                                                                  \
  void grid_lookup(const sw_grid::Levels& levels, int axes, int features, int64_t n, const float* x,                \
                   const float* table, float* found, const splatwizard::Parallel& parallel);                        \
  void grid_backward(const sw_grid::Levels& levels, int axes, int features, int64_t n, const float* x,              \
                     const float* gradient, float* table, const splatwizard::Parallel& parallel);                   \
  void signs_lookup(const sw_grid::Signs& at, const float* table, float* found,                                     \
                    const splatwizard::Parallel& parallel);                                                         \
  void signs_backward(const sw_grid::Signs& at, const float* gradient, float* table,                                \
                      const splatwizard::Parallel& parallel);                                                       \
  bool sites_lookup(const sw_sites::Sites& at, const float* const* tables, float* found,                            \
                    const splatwizard::Parallel& parallel);                                                         \
  void sites_backward(const sw_sites::Sites& at, const float* gradient, float* const* tables,                       \
                      const splatwizard::Parallel& parallel);                                                       \
  bool huffman_decode(const uint8_t* bytes, int64_t length, const float* counts, int64_t trees, int64_t size,       \
                      const int64_t* index, int64_t n, int32_t* symbols);                                           \
  double nearest_entries(const float* rows, int64_t n, const float* entries, int64_t size, int dim, int64_t* index, \
                         const splatwizard::Parallel& parallel);                                                    \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_GRID)
#undef SW_DECLARE_GRID
