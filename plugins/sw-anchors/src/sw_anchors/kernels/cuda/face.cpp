#include "face.h"

#include <splatwizard/cuda_face.h>

#include <limits>

#include "../calls.h"
#include "kernels.h"
#include "networks.h"
#include "rows.h"
#include "statistics.h"

using namespace sw_anchors;
using splatwizard::guarded_on_gpu;
using splatwizard::refuse;

namespace {

RowCopies copies_of(const copy_rows_call& call) {
  if (call.tensors < 0 || call.tensors > kTensors)
    refuse("rows of %lld tensors; at most %d are copied together", (long long)call.tensors, kTensors);
  RowCopies copies{};
  for (int64_t i = 0; i < call.tensors; ++i) {
    if (call.words[i] < 0 || copies.words + call.words[i] >= std::numeric_limits<int>::max())
      refuse("rows of %lld words", (long long)call.words[i]);
    copies.words += int(call.words[i]), copies.last[i] = copies.words;
    copies.from[i] = static_cast<const uint32_t*>(call.sources[i]);
    copies.to[i] = static_cast<uint32_t*>(call.targets[i]);
    copies.from_row[i] = call.source_rows[i], copies.to_row[i] = call.target_rows[i];
  }
  return copies;
}

template <class Call>
Rows rows_of(const Call& call) {
  if (call.count > 0 && (call.noise == nullptr) != (call.steps == nullptr)) refuse("noise and steps come together");
  if (call.steps != nullptr && call.step_rows != 1 && call.step_rows != call.count)
    refuse("%lld steps for %lld rows", (long long)call.step_rows, (long long)call.count);
  return {call.count, int(call.width), int(call.k), call.features, call.log_scales, call.offsets, call.logits,
          call.weights, call.valid, call.noise, call.steps, call.step_rows == call.count ? kGroups : 0,
          float(call.threshold)};
}

template <class Call>
cuda::Networks networks_of(const Call& call) {
  const int64_t inputs = call.inputs + 4;
  if (call.inputs < 0 || inputs > cuda::kMostInputs || call.units < 1 || call.units > cuda::kMostHidden)
    refuse("networks of %lld inputs and %lld hidden numbers are not offered", (long long)inputs, (long long)call.units);
  cuda::Networks networks{};
  networks.features = int(call.inputs), networks.hidden = int(call.units);
  const float* const last[cuda::kNetworks] = {call.opacity, call.geometry, call.color};
  const float* const last_bias[cuda::kNetworks] = {call.opacity_bias, call.geometry_bias, call.color_bias};
  const int64_t outputs[cuda::kNetworks] = {call.k, call.geometry_count, call.color_count};
  for (int n = 0; n < cuda::kNetworks; ++n) {
    if (outputs[n] < 1 || outputs[n] > cuda::kMostOutputs[n])
      refuse("a network of %lld outputs is not offered", (long long)outputs[n]);
    networks.outputs[n] = int(outputs[n]);
    networks.first[n] = call.first[n], networks.first_bias[n] = call.first_bias[n];
    networks.last[n] = last[n], networks.last_bias[n] = last_bias[n];
  }
  return networks;
}

template <class Call>
cuda::Viewed viewed_of(const Call& call) {
  return {call.n, call.feature_row, call.center, call.positions, call.features};
}

}  // namespace

SW_OPERATION(sw_anchors_cuda, spawn) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    cuda::spawn(outputs_of(*call), spawned_of(*call), stream);
  });
}

SW_OPERATION(sw_anchors_cuda, spawn_backward) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    cuda::spawn_backward(outputs_of(*call), slopes_of(*call), gradients_of(*call), call->ordered, stream);
  });
}

SW_OPERATION(sw_anchors_cuda, sample_bits) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    cuda::sample_bits(sample_of(*call), bits_of(*call), stream);
  });
}

SW_OPERATION(sw_anchors_cuda, copy_rows) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    if (call->way < 0 || call->way > 2) refuse("there is no way %d of copying", int(call->way));
    const RowCopies copies = copies_of(*call);
    cuda::clear(copies, call->cleared, stream);
    const auto copy = call->way == 0 ? cuda::gather : call->way == 1 ? cuda::scatter : cuda::add;
    copy(copies, call->rows, call->count, stream);
  });
}

SW_OPERATION(sw_anchors_cuda, row_values) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    cuda::values(rows_of(*call), call->values, call->masks, call->kept, stream);
  });
}

SW_OPERATION(sw_anchors_cuda, row_values_backward) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    const Rows from = rows_of(*call);
    if (call->to_steps != nullptr && from.step_row == 0) refuse("steps that learn are one for each row");
    const int64_t* const rows = call->by_rows;
    const RowSlopes by{{call->by_values, rows[0]},
                       {{call->by_features, rows[1]}, {call->by_scales, rows[2]}, {call->by_offsets, rows[3]}},
                       {call->by_masks, rows[4]}};
    cuda::values_backward(
        from, by,
        {call->to_features, call->to_log_scales, call->to_offsets, call->to_logits, call->to_steps}, stream);
  });
}

SW_OPERATION(sw_anchors_cuda, view_networks_sizes) {
  return guarded_on_gpu(call, [&](cudaStream_t) {
    call->parts = cuda::networks_parts(call->n), call->part = cuda::kPartial;
  });
}

SW_OPERATION(sw_anchors_cuda, view_networks) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    cuda::networks_forward(viewed_of(*call), networks_of(*call), {{call->alpha, call->raw_geometry, call->raw_color}},
                           stream);
  });
}

SW_OPERATION(sw_anchors_cuda, view_networks_backward) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    const cuda::Networks networks = networks_of(*call);
    const int64_t total = cuda::layout_of(networks).total, parts = cuda::networks_parts(call->n);
    if (call->total != total || call->parts < parts || call->part != cuda::kPartial)
      refuse("gradients are %lld numbers of %lld rows, not %lld of %lld", (long long)total, (long long)parts,
             (long long)call->total, (long long)call->parts);
    // Read only.
    const cuda::Outputs by{{const_cast<float*>(call->by_alpha), const_cast<float*>(call->by_geometry),
                            const_cast<float*>(call->by_color)}};
    cuda::networks_backward(viewed_of(*call), networks, call->alpha, by, call->to_features, call->partial,
                            call->to_parameters, stream);
  });
}

SW_OPERATION(sw_anchors_cuda, add_statistics) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    if (call->k < 1) refuse("anchors with %lld offsets", (long long)call->k);
    cuda::add_statistics({call->seen, call->k, call->count, call->rows, call->opacities, call->drawn, call->gradients,
                          call->radii},
                         {call->opacity_accum, call->anchor_denom, call->offset_grad_accum, call->offset_denom}, stream);
  });
}
