// The files of `hac` and `hac-plus` (docs/bitstream.md).
#include "methods_of_anchors.h"
#include "sign_grids.h"

namespace swz {

namespace {

constexpr int64_t AT_ONCE = 1 << 12;  // rows whose grid features are held

// Networks that give second Gaussians of features from those of the slices before them.
struct Channel {
  enum Kind : uint8_t { NONE, TINY, FULL } kind = NONE;
  IntegerList slices;
  int64_t hidden = 0, context = 0, numbers = 0;
  IntegerNetwork networks[MOST_LIST];
  Buffer<int64_t> first;  // outputs for the first slice, where nothing is before it

  void read_sizes(Container& file, int64_t features);
  void read_networks(Weights& weights, FileLayer* layers, const float*& free) const;
  void convert(const FileLayer* layers, const float* free);

 private:
  int64_t hidden_of(int64_t slice) const { return hidden ? hidden : 3 * slices[slice]; }
};

void Channel::read_sizes(Container& file, int64_t features) {
  const Json* stated = file.value("channel");
  if (stated == nullptr || !(stated->is("full") || stated->is("tiny") || stated->is("none")))
    refuse("header value 'channel' must be one of full, tiny, none");
  if (stated->is("none")) return;
  kind = stated->is("full") ? FULL : TINY;
  slices = IntegerList(file, "slices", 1, 256, MOST_LIST);
  if (slices.sum != features) refuse("the slices of the header do not sum to its features");
  if (kind == FULL) {
    hidden = file.integer("channel_hidden", 1, 512);
    context = 3 * features;
  }
  int64_t start = 0;
  for (int64_t i = 0; i < slices.count; ++i) {
    const int64_t inputs = start + context, outputs = 3 * slices[i];
    numbers += inputs ? numbers_of(inputs, hidden_of(i), outputs) : outputs;
    start += slices[i];
  }
  if (2 * numbers > (file.has("networks") ? file.section("networks").left : 0)) {
    const Blame blame("networks");
    refuse("channel networks of ", grouped(numbers), " numbers are not there");
  }
}

void Channel::read_networks(Weights& weights, FileLayer* layers, const float*& free) const {
  if (kind == TINY) free = weights.take(3 * slices[0]);
  int64_t start = 0;
  for (int64_t i = 0; i < slices.count; ++i) {
    if (start + context) {
      layers[2 * i] = weights.layer(start + context, hidden_of(i));
      layers[2 * i + 1] = weights.layer(hidden_of(i), 3 * slices[i]);
    }
    start += slices[i];
  }
}

void Channel::convert(const FileLayer* layers, const float* free) {
  if (kind == TINY) {
    first = Buffer<int64_t>(3 * slices[0]);
    for (int64_t i = 0; i < first.size; ++i) {
      if (!(__builtin_fabsf(free[i]) <= 1 << 20))
        refuse("ValueError: the free numbers of the first slice are not finite, or too large");
      first[i] = static_cast<int64_t>(__builtin_rint(double{free[i]} * 4096));
    }
  }
  for (int64_t i = kind == TINY ? 1 : 0; i < slices.count; ++i) networks[i] = IntegerNetwork(layers + 2 * i, 2, nullptr);
}

struct Sizes {
  Shape shape;
  int64_t hidden, grid_hidden;
  double base_steps[GROUPS];

  explicit Sizes(const Container& file) {
    shape.features = file.integer("feature_dim", 1, 256);
    hidden = file.integer("hidden", 1, 256);
    grid_hidden = file.integer("grid_hidden", 1, 256);
    file.integer("grid_features", 1, 16);
    check_mode(file);
    read_base_steps(file, 1e-6, 1e3, "1e-06..1000", base_steps);
    shape.offsets = file.integer("num_offsets", 1, 64);
  }
};

// Outputs of the network behind the grids for rows of codes.
void predict(const SignGrids& grids, const IntegerNetwork& network, const int64_t* codes, int64_t n, int64_t* outputs) {
  Buffer<int16_t> features(grids.width * (n < AT_ONCE ? n : AT_ONCE));
  for (int64_t begin = 0; begin < n; begin += AT_ONCE) {
    const int64_t rows = n - begin < AT_ONCE ? n - begin : AT_ONCE;
    grids.features(codes + 3 * begin, rows, features.data);
    network(rows, features.data, outputs + begin * network.outputs());
  }
}

// Features of a block, slice after slice, each under the mixture of both Gaussians.
void decode_slices(const Channel& channel, AttributeDecoder& attributes, int64_t begin, int64_t n,
                   const int64_t* outputs, int64_t stride) {
  const int64_t features = attributes.shape.features, logits = attributes.shape.outputs();
  Buffer<int64_t> known(n * features), context(channel.context * n);
  for (int64_t row = 0; row < n && channel.context; ++row) {
    const auto copy = [&](int64_t to, int64_t from, int64_t count) {
      std::memcpy(context.data + row * channel.context + to, outputs + row * stride + from,
                  sizeof(int64_t) * static_cast<size_t>(count));
    };
    copy(0, 0, 2 * features);
    copy(2 * features, logits, features);
  }
  int64_t start = 0;
  for (int64_t i = 0; i < channel.slices.count; ++i) {
    const int64_t size = channel.slices[i];
    Buffer<int64_t> second(3 * size * n), logit(size * n);
    if (channel.kind == Channel::TINY && i == 0)
      for (int64_t row = 0; row < n; ++row)
        std::memcpy(second.data + 3 * size * row, channel.first.data, sizeof(int64_t) * static_cast<size_t>(3 * size));
    else
      channel.networks[i](n, known.data, start, features, context.data, channel.context, channel.context, second.data,
                          LEAK);
    for (int64_t row = 0; row < n; ++row)
      for (int64_t c = 0; c < size; ++c)
        logit[row * size + c] = outputs[row * stride + logits + start + c] - second[3 * size * row + 2 * size + c];
    attributes.mixtures(static_cast<int>(i), begin, n, start, size,
                        {{{outputs + start, stride}, {second.data, 3 * size}},
                         {{outputs + features + start, stride}, {second.data + size, 3 * size}},
                         {logit.data, size}},
                        known.data + start, features);
    start += size;
  }
}

void decode_with_grids(Container& file, const Sizes& sizes, const Geometry& geometry, Channel& channel) {
  const Shape& shape = sizes.shape;
  const SignGrids grids(file);
  const int64_t further = channel.kind ? shape.features : 0, outputs = shape.outputs() + further;
  DecodedAnchors to;
  IntegerNetwork network;
  {
    Weights weights(file, networks_of_anchors(shape, sizes.hidden) +
                              numbers_of(grids.width, sizes.grid_hidden, outputs) + channel.numbers);
    const Blame blame("networks");
    to = DecodedAnchors(geometry, shape, sizes.hidden, weights);
    FileLayer layers[2], slices[2 * MOST_LIST];
    layers[0] = weights.layer(grids.width, sizes.grid_hidden);
    layers[1] = weights.layer(sizes.grid_hidden, outputs);
    const float* free = nullptr;
    if (channel.kind) channel.read_networks(weights, slices, free);
    Buffer<double> units(outputs);
    put_units(shape, sizes.base_steps, units.data);
    for (int64_t i = shape.outputs(); i < outputs; ++i) units[i] = 1;
    network = IntegerNetwork(layers, 2, units.data);
    if (channel.kind) channel.convert(slices, free);
  }

  const ExactTables tables = exact_tables();
  AttributeDecoder attributes(file, geometry, shape, sizes.base_steps, tables, to);
  if (channel.kind)
    for (int64_t i = 1; i <= channel.slices.count; ++i) attributes.add(numbered("features.", i));
  else
    attributes.add("features");
  const auto scalings = static_cast<int>(attributes.count);
  attributes.add("scalings");
  attributes.add("offsets");
  const int64_t most = attributes.block_rows();
  Buffer<int64_t> found(outputs * (geometry.count < most ? geometry.count : most));
  for (int64_t begin = 0; begin < geometry.count; begin += most) {
    const int64_t n = geometry.count - begin < most ? geometry.count - begin : most;
    predict(grids, network, geometry.codes.data + 3 * begin, n, found.data);
    attributes.begin(n, found.data + shape.outputs() - GROUPS, outputs, 0);
    const int64_t* mean = found.data;
    if (channel.kind) decode_slices(channel, attributes, begin, n, found.data, outputs);
    for (int group = 0; group < GROUPS; ++group) {
      const int64_t width = shape.width(group);
      if (group || !channel.kind)
        attributes.gaussians(group ? scalings + group - 1 : 0, group, begin, n, 0, width, {mean, outputs},
                             {mean + width, outputs});
      mean += 2 * width;
    }
  }
  attributes.finish();
}

}  // namespace

void decode_hac(Container& file) {
  const Sizes sizes(file);
  Geometry geometry;
  geometry.read_counts(file, sizes.shape);
  {
    const Bytes data = file.section("anchors");
    const Blame blame("anchors");
    geometry.read_anchors(data);
  }
  geometry.read_masks(file);
  Channel none;
  decode_with_grids(file, sizes, geometry, none);
}

void decode_hac_plus(Container& file) {
  const Sizes sizes(file);
  Channel channel;
  channel.read_sizes(file, sizes.shape.features);
  Geometry geometry;
  geometry.read_counts(file, sizes.shape);
  {
    const Bytes data = file.section("anchors");
    const Blame blame("anchors");
    geometry.read_voxels(data);
  }
  geometry.read_masks(file);
  decode_with_grids(file, sizes, geometry, channel);
}

}  // namespace swz
