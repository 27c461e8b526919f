// Registers networks and look-ups of the exact mode as torch ops; checks what they are handed.
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <torch/library.h>

#include <vector>

#include <splatwizard/torch_parallel.h>

#include "binding.h"

namespace {

using at::Tensor;
using namespace splatwizard;

// A network on inputs [n, in] i64 or i16, or on two of i64 side by side; layers: W [out, in] and b [out] f64 in turn.
struct Network {
  std::vector<Layer> layers;
  NetworkArgs args{};

  Network(at::TensorList inputs, at::TensorList tensors, const char* op) {
    TORCH_CHECK(inputs.size() == 1 || inputs.size() == 2, op, ": inputs must be one or two tensors");
    TORCH_CHECK(tensors.size() >= 2 && tensors.size() % 2 == 0, op, ": weights and biases must come in pairs");
    args.rows = inputs[0].size(0);
    int64_t width = 0;
    if (inputs.size() == 1 && inputs[0].scalar_type() == at::kShort) {
      check(inputs[0], at::kShort, 2, op, "inputs");
      args.short_inputs = inputs[0].const_data_ptr<int16_t>();
      width = inputs[0].size(1);
    } else {
      for (size_t i = 0; i < inputs.size(); ++i) {
        const Tensor& each = inputs[i];
        TORCH_CHECK(each.is_cpu() && each.scalar_type() == at::kLong && each.dim() == 2 && each.size(0) == args.rows &&
                        (each.size(1) < 2 || each.stride(1) == 1),
                    op, ": inputs must be int64 [n, columns] on the CPU");
        args.inputs[i] = each.const_data_ptr<int64_t>();
        args.stride[i] = each.stride(0);
        width += args.width[i] = each.size(1);
      }
    }
    for (size_t i = 0; i < tensors.size(); i += 2) {
      check(tensors[i], at::kDouble, 2, op, "weights");
      check(tensors[i + 1], at::kDouble, 1, op, "biases");
      const int64_t out = tensors[i].size(0);
      TORCH_CHECK(tensors[i].size(1) == width && tensors[i + 1].size(0) == out, op, ": layers do not fit");
      layers.push_back({tensors[i].const_data_ptr<double>(), tensors[i + 1].const_data_ptr<double>(), width, out});
      width = out;
    }
    args.layers = layers.data();
    args.depth = static_cast<int64_t>(layers.size());
  }
  int64_t outputs() const { return layers.back().outputs; }
};

// Writes outputs [n, out] i64; `leak`: slope of activations below 0, in 1/4096.
void network(at::TensorList inputs, at::TensorList layers, int64_t leak, const Tensor& outputs) {
  const char* op = "network";
  Network found(inputs, layers, op);
  TORCH_CHECK(leak >= 0 && leak <= 4096, op, ": leak must be 0..4096");
  found.args.leak = leak;
  check(outputs, at::kLong, 2, op, "outputs");
  TORCH_CHECK(outputs.size(0) == found.args.rows && outputs.size(1) == found.outputs(), op, ": outputs do not fit");
  SW_SELECT(network)(found.args, outputs.mutable_data_ptr<int64_t>(), torch_parallel());
}

// Writes centre and number [n, C] of each group and steps [n, groups] i64, for multipliers [128]; the status.
int64_t forecast(at::TensorList inputs, at::TensorList layers, const Tensor& multipliers, const Tensor& thresholds,
                 at::TensorList centre, at::TensorList number, const Tensor& steps) {
  const char* op = "forecast";
  const Network found(inputs, layers, op);
  check(multipliers, at::kLong, 1, op, "multipliers");
  check(thresholds, at::kLong, 1, op, "thresholds");
  check(steps, at::kLong, 2, op, "steps");
  ForecastArgs args{};
  args.groups = static_cast<int64_t>(centre.size());
  TORCH_CHECK(multipliers.numel() == 128 && thresholds.numel() == 63 && args.groups >= 1 && args.groups <= 4 &&
                  number.size() == centre.size() && steps.size(0) == found.args.rows && steps.size(1) == args.groups,
              op, ": one to four groups, 128 multipliers and 63 thresholds");
  args.multipliers = multipliers.const_data_ptr<int64_t>();
  for (int64_t i = 0; i < 128; ++i)
    TORCH_CHECK(args.multipliers[i] >= 64 && args.multipliers[i] <= 16384, op, ": a multiplier leaves 64..16384");
  args.thresholds = thresholds.const_data_ptr<int64_t>();
  args.steps = steps.mutable_data_ptr<int64_t>();
  int64_t outputs = args.groups;
  for (size_t g = 0; g < centre.size(); ++g) {
    check(centre[g], at::kInt, 2, op, "centre");
    check(number[g], at::kShort, 2, op, "number");
    TORCH_CHECK(centre[g].size(0) == found.args.rows && number[g].sizes() == centre[g].sizes(), op,
                ": centre and number must be [n, columns]");
    args.columns[g] = centre[g].size(1);
    args.centre[g] = centre[g].mutable_data_ptr<int32_t>();
    args.number[g] = number[g].mutable_data_ptr<int16_t>();
    outputs += 2 * args.columns[g];
  }
  TORCH_CHECK(outputs == found.outputs(), op, ": the network has ", found.outputs(), " outputs, not ", outputs);
  return SW_SELECT(forecast)(found.args, args, torch_parallel());
}

// Writes the columns of a grid into out [n, width] i64 or i16. signs [entries] i16: bit f is sign f; levels [3, L]: R - 1,
// first entry and first column, dense levels first.
void grid_features(const Tensor& codes, at::IntArrayRef axes, const Tensor& signs, int64_t features,
                   const Tensor& levels, int64_t dense, int64_t log2_size, const Tensor& out) {
  const char* op = "grid_features";
  check(codes, at::kLong, 2, op, "codes");
  check(signs, at::kShort, 1, op, "signs");
  check(levels, at::kLong, 2, op, "levels");
  const bool narrow = out.scalar_type() == at::kShort;
  check(out, narrow ? at::kShort : at::kLong, 2, op, "out");
  const auto dimensions = static_cast<int>(axes.size());
  TORCH_CHECK(codes.size(1) == 3 && (dimensions == 2 || dimensions == 3) && levels.size(0) == 3 && features >= 1 &&
                  features <= 16 && log2_size >= 3 && log2_size <= 30 && out.size(0) == codes.size(0) && dense >= 0 &&
                  dense <= levels.size(1),
              op, ": shapes do not fit");
  GridArgs args{};
  args.codes = codes.const_data_ptr<int64_t>();
  for (int d = 0; d < dimensions; ++d) {
    TORCH_CHECK(axes[static_cast<size_t>(d)] >= 0 && axes[static_cast<size_t>(d)] < 3, op, ": axes must be below 3");
    args.axes[d] = static_cast<int>(axes[static_cast<size_t>(d)]);
  }
  args.dimensions = dimensions;
  args.signs = reinterpret_cast<const uint16_t*>(signs.const_data_ptr<int16_t>());
  args.features = static_cast<int>(features);
  args.levels = levels.size(1);
  args.last = levels.const_data_ptr<int64_t>();
  args.start = args.last + args.levels;
  args.column = args.start + args.levels;
  args.dense = dense;
  args.log2_size = log2_size;
  args.rows = codes.size(0);
  if (narrow)
    args.short_out = out.mutable_data_ptr<int16_t>();
  else
    args.out = out.mutable_data_ptr<int64_t>();
  args.stride = out.size(1);
  for (int64_t i = 0; i < args.levels; ++i) {
    int64_t entries = int64_t{1} << log2_size;
    if (i < dense) {
      entries = 1;
      for (int d = 0; d < dimensions; ++d) entries *= args.last[i] + 1;
    }
    TORCH_CHECK(args.last[i] >= 1 && args.last[i] < 1 << 16 && args.start[i] >= 0 &&
                    args.start[i] + entries <= signs.numel() && args.column[i] >= 0 &&
                    args.column[i] + features <= args.stride,
                op, ": level ", i, " does not fit its table");
  }
  SW_SELECT(grid_features)(args, torch_parallel());
}

// [n, scales * 3 * C] i64 of places [n, 3] i64 and planes [3, R * R, C] i32 for each scale.
Tensor triplane_features(const Tensor& places, at::TensorList planes, at::IntArrayRef sizes) {
  const char* op = "triplane_features";
  check(places, at::kLong, 2, op, "places");
  TORCH_CHECK(places.size(1) == 3 && !planes.empty() && planes.size() <= 4 && planes.size() == sizes.size(), op,
              ": one to four scales of planes");
  TriplaneArgs args{};
  args.places = places.const_data_ptr<int64_t>();
  args.scales = static_cast<int64_t>(planes.size());
  args.channels = planes[0].size(2);
  for (size_t i = 0; i < planes.size(); ++i) {
    check(planes[i], at::kInt, 3, op, "planes");
    TORCH_CHECK(sizes[i] >= 1 && planes[i].size(0) == 3 && planes[i].size(1) == sizes[i] * sizes[i] &&
                    planes[i].size(2) == args.channels,
                op, ": planes must be [3, R * R, C]");
    args.planes[i] = planes[i].const_data_ptr<int32_t>();
    args.size[i] = sizes[i];
  }
  args.rows = places.size(0);
  Tensor out = at::empty({args.rows, args.scales * 3 * args.channels}, places.options());
  args.out = out.mutable_data_ptr<int64_t>();
  SW_SELECT(triplane_features)(args, torch_parallel());
  return out;
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sw_codecs_exact, m) {
  m.def("forecast(Tensor[] inputs, Tensor[] layers, Tensor multipliers, Tensor thresholds, Tensor(a!)[] centre,"
        " Tensor(b!)[] number, Tensor(c!) steps) -> int");
  m.def("network(Tensor[] inputs, Tensor[] layers, int leak, Tensor(a!) outputs) -> ()");
  m.def("grid_features(Tensor codes, int[] axes, Tensor signs, int features, Tensor levels, int dense, int log2_size,"
        " Tensor(a!) out) -> ()");
  m.def("triplane_features(Tensor places, Tensor[] planes, int[] sizes) -> Tensor");
  m.impl("forecast", c10::DispatchKey::CPU, TORCH_FN(forecast));
  m.impl("network", c10::DispatchKey::CPU, TORCH_FN(network));
  m.impl("grid_features", c10::DispatchKey::CPU, TORCH_FN(grid_features));
  m.impl("triplane_features", c10::DispatchKey::CPU, TORCH_FN(triplane_features));
}
