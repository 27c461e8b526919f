// The kernels of the CPU, declared once for every instruction set that they are compiled for.
#pragma once

#include <splatwizard/dispatch.h>
#include <splatwizard/parallel.h>

#include "kernels.h"

#define SW_DECLARE_WISP(arch)                                                                       \
  namespace arch {                                                                                  \
  void eight_bits(const sw_wisp::Matrices& of, const splatwizard::Parallel& parallel);              \
  void draw(const sw_wisp::Draw& of, const splatwizard::Parallel& parallel);                        \
  void draw_backward(const sw_wisp::DrawBack& of, const splatwizard::Parallel& parallel);           \
  void bits(const sw_wisp::CountedRows& of, const splatwizard::Parallel& parallel);                 \
  void bits_backward(const sw_wisp::CountedRows& of, const splatwizard::Parallel& parallel);        \
  void splats(const sw_wisp::Splats& of, const splatwizard::Parallel& parallel);                    \
  void splats_backward(const sw_wisp::SplatsBack& of, const splatwizard::Parallel& parallel);       \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_WISP)
#undef SW_DECLARE_WISP
