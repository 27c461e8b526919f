// Behind the face: networks and look-ups in integers.
#include <vector>

#include "face.h"
#include "kernels.h"

namespace {

using namespace splatwizard;

// The network of a call; its layers go to `layers`.
template <class Call>
NetworkArgs network_of(const Call* call, std::vector<Layer>& layers) {
  NetworkArgs args{};
  const auto lacks = [&](const void* from, int64_t columns) { return from == nullptr && call->rows > 0 && columns > 0; };
  if (lacks(call->inputs, call->columns) || lacks(call->further, call->more) ||
      lacks(call->short_inputs, call->short_columns))
    refuse("inputs are missing");
  if (call->short_inputs == nullptr) {
    args.inputs[0] = call->inputs;
    args.inputs[1] = call->further;
    args.width[0] = call->columns;
    args.width[1] = call->more;
    args.stride[0] = call->stride;
    args.stride[1] = call->further_stride;
  }
  const int64_t columns = call->short_columns + call->columns + call->more;
  args.short_inputs = call->short_inputs;
  args.rows = call->rows;
  if (call->ends < 2 || call->widths[0] != columns) refuse("the layers do not fit %lld inputs", (long long)columns);
  const double* at = call->weights;
  int64_t left = call->numbers;
  for (int64_t i = 1; i < call->ends; ++i) {
    const int64_t in = call->widths[i - 1], out = call->widths[i];
    if (in < 0 || out < 0 || in >= 1 << 24 || out >= 1 << 24 || (in + 1) * out > left)
      refuse("layer %lld leaves the weights", (long long)(i - 1));
    layers.push_back({at, at + in * out, in, out});
    at += (in + 1) * out;
    left -= (in + 1) * out;
  }
  if (left != 0) refuse("there are more weights than layers take");
  args.layers = layers.data();
  args.depth = static_cast<int64_t>(layers.size());
  return args;
}

}  // namespace

SW_OPERATION(sw_codecs_exact, network) {
  return guarded(call, [&](const Parallel& parallel) {
    std::vector<Layer> layers;
    NetworkArgs args = network_of(call, layers);
    if (call->leak < 0 || call->leak > 4096) refuse("leak must be 0 .. 4096");
    if (call->last != layers.back().outputs) refuse("the network has %lld outputs", (long long)layers.back().outputs);
    args.leak = call->leak;
    SW_SELECT(network)(args, call->outputs, parallel);
  });
}

SW_OPERATION(sw_codecs_exact, forecast) {
  return guarded(call, [&](const Parallel& parallel) {
    std::vector<Layer> layers;
    const NetworkArgs args = network_of(call, layers);
    ForecastArgs told{};
    if (call->groups < 1 || call->groups > 4) refuse("one to four groups");
    told.groups = call->groups;
    told.multipliers = call->multipliers;
    for (int64_t i = 0; i < 128; ++i)
      if (call->multipliers[i] < 64 || call->multipliers[i] > 16384) refuse("a multiplier leaves 64 .. 16384");
    told.thresholds = call->thresholds;
    told.steps = call->steps;
    int64_t outputs = told.groups;
    for (int64_t g = 0; g < told.groups; ++g) {
      told.columns[g] = call->group_columns[g];
      told.centre[g] = call->centre[g];
      told.number[g] = call->number[g];
      outputs += 2 * told.columns[g];
    }
    if (outputs != layers.back().outputs)
      refuse("the network has %lld outputs, not %lld", (long long)layers.back().outputs, (long long)outputs);
    call->status = SW_SELECT(forecast)(args, told, parallel);
  });
}

SW_OPERATION(sw_codecs_exact, grid_features) {
  return guarded(call, [&](const Parallel& parallel) {
    if ((call->dimensions != 2 && call->dimensions != 3) || call->features < 1 || call->features > 16 ||
        call->log2_size < 3 || call->log2_size > 30 || call->dense < 0 || call->dense > call->depth ||
        (call->rows > 0 && (call->found == nullptr) == (call->short_found == nullptr)))
      refuse("shapes do not fit");
    GridArgs args{};
    args.codes = call->codes;
    for (int64_t d = 0; d < call->dimensions; ++d) {
      if (call->axes[d] < 0 || call->axes[d] > 2) refuse("axes must be below 3");
      args.axes[d] = static_cast<int>(call->axes[d]);
    }
    args.dimensions = static_cast<int>(call->dimensions);
    args.signs = call->signs;
    args.features = static_cast<int>(call->features);
    args.levels = call->depth;
    args.last = call->levels;
    args.start = args.last + args.levels;
    args.column = args.start + args.levels;
    args.dense = call->dense;
    args.log2_size = call->log2_size;
    args.rows = call->rows;
    args.out = call->found;
    args.short_out = call->short_found;
    args.stride = call->width;
    for (int64_t i = 0; i < args.levels; ++i) {
      int64_t entries = int64_t{1} << call->log2_size;
      const bool is_size = args.last[i] >= 1 && args.last[i] < 1 << 16;
      if (is_size && i < call->dense) {
        entries = 1;
        for (int64_t d = 0; d < call->dimensions; ++d) entries *= args.last[i] + 1;
      }
      if (!is_size || args.start[i] < 0 || args.start[i] > call->entries - entries || args.column[i] < 0 ||
          args.column[i] > args.stride - call->features)
        refuse("level %lld does not fit its table", (long long)i);
    }
    SW_SELECT(grid_features)(args, parallel);
  });
}

SW_OPERATION(sw_codecs_exact, triplane_features) {
  return guarded(call, [&](const Parallel& parallel) {
    if (call->scales < 1 || call->scales > 4 || call->channels < 0 || call->width != 3 * call->scales * call->channels)
      refuse("one to four scales of planes");
    TriplaneArgs args{};
    args.places = call->places;
    for (int64_t i = 0; i < call->scales; ++i) {
      if (call->sizes[i] < 1) refuse("planes must be [3, R * R, C]");
      args.planes[i] = call->planes[i];
      args.size[i] = call->sizes[i];
    }
    args.scales = call->scales;
    args.channels = call->channels;
    args.rows = call->rows;
    args.out = call->found;
    SW_SELECT(triplane_features)(args, parallel);
  });
}
