// The kernels of the CPU, declared once for every instruction set that they are compiled for.
//
//   spawn            the Gaussians of `from.drawn`
//   spawn_backward   gradients of all anchors, which hold zeros before; sums of an anchor in the order of its Gaussians,
//                    so that they are the same for any number of threads
//   heads_rows       rows of `hidden` for n anchors, the last ones padding; heads_width: floats of a row
//   heads_opacities  hidden layers [rows, width], opacities [n,k] before masks and after them
//   heads_spawn      outputs of the other networks for `from.drawn`, [count,7] and [count,3], and their Gaussians;
//                    `from.geometry` and `from.color` are these outputs, `compact`
//   heads_backward   all gradients, `to` as of spawn_backward, `to_features` [n, features]; sums of weights the same for
//                    any number of threads
//   noisy_values     values of some anchors with noise, and all numbers of a sample of these
//   predicted_steps  quantiser steps [count,3], the hidden layer and tanh of the outputs; backward: of `to_steps` and
//                    `to_hidden`, sums the same for any number of threads
//   sample_bits      bits of a sample of anchors by group, and their derivatives, row by row
#pragma once

#include <splatwizard/dispatch.h>
#include <splatwizard/parallel.h>

#include "heads.h"
#include "sample.h"
#include "spawn.h"
#include "steps.h"
#include "values.h"

#define SW_DECLARE_ANCHORS(arch)                                                                                  \
  namespace arch {                                                                                              \
  void spawn(const sw_anchors::Anchors& from, const sw_anchors::Gaussians& to,                                  \
             const splatwizard::Parallel& parallel);                                                            \
  void spawn_backward(const sw_anchors::Anchors& from, const sw_anchors::Gaussians& slope,                      \
                      const sw_anchors::Gradients& to, const splatwizard::Parallel& parallel);                  \
  int64_t heads_rows(int64_t n);                                                                                \
  int64_t heads_width(const sw_anchors::Heads& heads);                                                          \
  void heads_opacities(const sw_anchors::Anchors& from, const sw_anchors::Seen& seen,                           \
                       const sw_anchors::Heads& heads, float* hidden, float* alpha, float* opacities,           \
                       const splatwizard::Parallel& parallel);                                                  \
  void heads_spawn(const sw_anchors::Anchors& from, const sw_anchors::Heads& heads, const float* hidden,        \
                   float* geometry, float* color, const sw_anchors::Gaussians& to,                              \
                   const splatwizard::Parallel& parallel);                                                      \
  void heads_backward(const sw_anchors::Anchors& from, const sw_anchors::Seen& seen,                            \
                      const sw_anchors::Heads& heads, const float* hidden, const sw_anchors::Gaussians& slope,  \
                      const sw_anchors::Gradients& to, float* to_features,                                      \
                      const sw_anchors::HeadGradients& to_heads, const splatwizard::Parallel& parallel);        \
  void noisy_values(const sw_anchors::Rows& from, const sw_anchors::RowValues& to,                              \
                    const splatwizard::Parallel& parallel);                                                     \
  void noisy_values_backward(const sw_anchors::Rows& from, const sw_anchors::RowValues& slope,                  \
                             const sw_anchors::RowGradients& to, const splatwizard::Parallel& parallel);        \
  void predicted_steps(const sw_anchors::StepNetwork& of, float* hidden, float* tangents, float* steps,         \
                       const splatwizard::Parallel& parallel);                                                  \
  void predicted_steps_backward(const sw_anchors::StepNetwork& of, const float* hidden, const float* tangents,  \
                                const float* to_steps, const float* to_hidden,                                  \
                                const sw_anchors::StepGradients& to, const splatwizard::Parallel& parallel);    \
  void sample_bits(const sw_anchors::Sample& from, const sw_anchors::SampleBits& to,                            \
                   const splatwizard::Parallel& parallel);                                                      \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_ANCHORS)
#undef SW_DECLARE_ANCHORS
