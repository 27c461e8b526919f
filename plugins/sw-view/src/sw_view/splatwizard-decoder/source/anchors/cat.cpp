// The files of `cat-3dgs` (docs/bitstream.md).
#include "methods_of_anchors.h"
#include "anchors.h"
#include "arrays.h"
#include "planes.h"

namespace swz {

namespace {

constexpr int64_t OFFSET = 410;  // of step multipliers
constexpr int64_t NUMBERS_AT_ONCE = 1 << 18;
constexpr int64_t PLANES_FREE = 1 << 20, PLANES_PER_ANCHOR = 1024;  // sw_cat_3dgs.codec

struct Sizes {
  Shape shape;
  int64_t hidden, channels, context_hidden, slice_hidden, resolution;
  IntegerList slices, multiples;
  bool refines;
  double base_steps[GROUPS];

  explicit Sizes(const Container& file) {
    check_mode(file);
    shape.features = file.integer("feature_dim", 1, 256);
    hidden = file.integer("hidden", 1, 256);
    channels = file.integer("channels", 1, 512);
    context_hidden = file.integer("context_hidden", 1, 512);
    slice_hidden = file.integer("slice_hidden", 1, 512);
    resolution = file.integer("resolution", 0, 1 << 14);
    slices = IntegerList(file, "slices", 1, 256, MOST_LIST);
    if (slices.sum != shape.features) refuse("the slices of the header do not sum to its features");
    read_base_steps(file, 1e-9, 1e9, "1e-09..1e+09", base_steps);
    if (base_steps[0] != 1) refuse("the base step of the features must be 1");
    shape.offsets = file.integer("num_offsets", 1, 64);
    multiples = IntegerList(file, "multiples", 1, 16, MOST_SCALES);
    refines = file.integer("refine", 0, 1);
  }
};

// Networks that refine what the context says, from the features that are known.
struct Slices {
  IntegerNetwork networks[MOST_LIST], further[2];  // of each slice but the first; of scales and offsets

  static int64_t numbers(const Sizes& sizes) {
    int64_t found = 0, start = sizes.slices[0];
    for (int64_t i = 1; i < sizes.slices.count; ++i) {
      found += numbers_of(start, sizes.slice_hidden, 2 * sizes.slices[i]);
      start += sizes.slices[i];
    }
    for (int group = 1; group < GROUPS && sizes.refines; ++group)
      found += numbers_of(start, sizes.slice_hidden, 2 * sizes.shape.width(group));
    return found;
  }
};

// Whole numbers of the affine map from codes to standard deviations, and the box.
struct Frame {
  int64_t slope[3][3], constant[3], low[3], width[3];
  int extra[3];

  Frame(Bytes rows, const Geometry& geometry);
  void place(const int64_t* code, int64_t* to) const;
};

Frame::Frame(Bytes rows, const Geometry& geometry) {
  double numbers[7][3], slopes[3][3], shift[3], largest[3], box[2][3];
  for (int i = 0; i < 21; ++i) numbers[i / 3][i % 3] = float_at(rows.data + 4 * i);
  const auto* axes = numbers + 1;
  bool fits = true;
  for (int i = 0; i < 3; ++i) {
    const double deviation = numbers[4][i];
    for (int j = 0; j < 3; ++j) slopes[i][j] = axes[j][i] * geometry.step[j] / deviation;
    double sum = axes[0][i] * (geometry.low[0] - numbers[0][0]);
    sum += axes[1][i] * (geometry.low[1] - numbers[0][1]);
    sum += axes[2][i] * (geometry.low[2] - numbers[0][2]);
    shift[i] = sum / deviation;
    const double size = __builtin_fabs(slopes[i][0]) + __builtin_fabs(slopes[i][1]) + __builtin_fabs(slopes[i][2]);
    largest[i] = (size * 65536 + __builtin_fabs(shift[i])) * 65536;
    fits &= largest[i] < 0x1p61;
    for (int side = 0; side < 2; ++side) {
      box[side][i] = __builtin_rint(numbers[5 + side][i] * 0x1p18);
      fits &= __builtin_fabs(box[side][i]) < 0x1p30;
    }
  }
  if (!fits) refuse("ValueError: the frame of the triplane is not usable: its constants are damaged or hostile");
  for (int i = 0; i < 3; ++i) {
    extra[i] = 20;
    while (extra[i] > 0 && !(largest[i] * power_of_two(extra[i]) < 0x1p61)) extra[i] -= 4;
    const double unit = power_of_two(16 + extra[i]);
    for (int j = 0; j < 3; ++j) slope[i][j] = static_cast<int64_t>(__builtin_rint(slopes[i][j] * unit));
    constant[i] = static_cast<int64_t>(__builtin_rint(shift[i] * unit));
    low[i] = static_cast<int64_t>(box[0][i]);
    width[i] = static_cast<int64_t>(box[1][i]) - low[i];
    if (width[i] < 1) width[i] = 1;
  }
}

int64_t quotient(int64_t a, int64_t b) {  // rounded down; b > 0
  const int64_t q = a / b;
  return q - (a % b < 0);
}

void Frame::place(const int64_t* code, int64_t* to) const {
  constexpr int64_t ONE = 1 << 16, FAR = 1 << 26, UNIT = 1 << 20;
  int64_t y[3], square = 0;
  for (int i = 0; i < 3; ++i) {
    const int64_t total = code[0] * slope[i][0] + code[1] * slope[i][1] + code[2] * slope[i][2] + constant[i];
    y[i] = total >> extra[i];
    y[i] = y[i] < -FAR ? -FAR : y[i] > FAR ? FAR : y[i];
    square += y[i] * y[i];
  }
  auto norm = static_cast<int64_t>(__builtin_sqrt(static_cast<double>(square)));
  norm -= norm * norm > square;
  norm += (norm + 1) * (norm + 1) <= square;
  for (int i = 0; i < 3; ++i) {
    const int64_t pulled = norm > ONE ? quotient(((2 * norm - ONE) << 16) / norm * y[i], norm) : y[i];
    const int64_t found = quotient((pulled + 2 * ONE - low[i]) * UNIT, width[i]);
    to[i] = found < 0 ? 0 : found > UNIT ? UNIT : found;
  }
}

// Outputs of the context for rows of codes.
void predict(const Planes& planes, const Frame& frame, const IntegerNetwork& network, const int64_t* codes, int64_t n,
             int64_t* outputs) {
  const int64_t width = 3 * planes.channels * planes.scales;
  const int64_t most = NUMBERS_AT_ONCE / width < n ? NUMBERS_AT_ONCE / width : n;
  Buffer<int64_t> places(3 * most), features(width * most);
  for (int64_t begin = 0; begin < n; begin += most) {
    const int64_t rows = n - begin < most ? n - begin : most;
    for (int64_t i = 0; i < rows; ++i) frame.place(codes + 3 * (begin + i), places.data + 3 * i);
    planes.features(places.data, rows, features.data);
    network(rows, features.data, width, width, nullptr, 0, 0, outputs + begin * network.outputs());
  }
}

struct Refined {
  Buffer<int64_t> mean, scale;
};

// Means and scales [n, columns], `stride` apart, plus the outputs of a network for the first `inputs` known features.
Refined refined(const IntegerNetwork& network, const int64_t* known, int64_t inputs, int64_t features, int64_t n,
                const int64_t* mean, const int64_t* scale, int64_t stride, int64_t columns) {
  Refined found{Buffer<int64_t>(n * columns), Buffer<int64_t>(n * columns)};
  Buffer<int64_t> change(2 * n * columns);
  network(n, known, inputs, features, nullptr, 0, 0, change.data);
  for (int64_t row = 0; row < n; ++row)
    for (int64_t c = 0; c < columns; ++c) {
      found.mean[row * columns + c] = mean[row * stride + c] + change[2 * row * columns + c];
      found.scale[row * columns + c] = scale[row * stride + c] + change[(2 * row + 1) * columns + c];
    }
  return found;
}

void decode_block(AttributeDecoder& attributes, const Sizes& sizes, const Slices& slices, int64_t begin, int64_t n,
                  const int64_t* outputs, int64_t stride) {
  const Shape& shape = sizes.shape;
  const int64_t features = shape.features;
  attributes.begin(n, outputs + stride - GROUPS, stride, OFFSET);
  Buffer<int64_t> known(n * features);
  int64_t start = 0;
  for (int64_t i = 0; i < sizes.slices.count; ++i) {
    const int64_t size = sizes.slices[i], *mean = outputs + start, *scale = mean + features;
    const Refined own = i ? refined(slices.networks[i], known.data, start, features, n, mean, scale, stride, size)
                          : Refined{};
    attributes.gaussians(static_cast<int>(i), 0, begin, n, start, size,
                         i ? Integers{own.mean.data, size} : Integers{mean, stride},
                         i ? Integers{own.scale.data, size} : Integers{scale, stride}, known.data + start, features);
    start += size;
  }
  const int64_t* mean = outputs + 2 * features;
  for (int group = 1; group < GROUPS; ++group) {
    const int64_t width = shape.width(group), *scale = mean + width;
    const int section = static_cast<int>(sizes.slices.count) + group - 1;
    const Refined own = sizes.refines ? refined(slices.further[group - 1], known.data, features, features, n, mean,
                                                scale, stride, width)
                                      : Refined{};
    attributes.gaussians(section, group, begin, n, 0, width,
                         sizes.refines ? Integers{own.mean.data, width} : Integers{mean, stride},
                         sizes.refines ? Integers{own.scale.data, width} : Integers{scale, stride});
    mean += 2 * width;
  }
}

}  // namespace

void decode_cat(Container& file) {
  const Sizes sizes(file);
  const Shape& shape = sizes.shape;
  Planes planes;
  planes.scales = sizes.multiples.count, planes.channels = sizes.channels;
  for (int64_t s = 0; s < planes.scales; ++s) planes.size[s] = sizes.multiples[s] * sizes.resolution;
  const int64_t n = file.integer("num_anchors", 0, UINT32_MAX);
  file.allow_what(n * shape.decoded_bytes() + 4 * planes.integers(), "a model of ", grouped(n),
                  " anchors and planes of base ", sizes.resolution);
  if ((n > 0) != (sizes.resolution > 0)) refuse("header gives ", grouped(n), " anchors planes of ", sizes.resolution);
  if (planes.integers() > PLANES_FREE + PLANES_PER_ANCHOR * n)
    refuse("planes of base ", sizes.resolution, " are too large for ", grouped(n), " anchors");
  Geometry geometry;
  geometry.read_counts(file, shape);
  {
    const Bytes data = file.section("anchors");
    const Blame blame("anchors");
    geometry.read_anchors(data);
  }
  geometry.read_masks(file);

  const int64_t inputs = 3 * planes.channels * planes.scales, outputs = shape.outputs();
  Weights weights(file, networks_of_anchors(shape, sizes.hidden) +
                            numbers_of(inputs, sizes.context_hidden, outputs) + Slices::numbers(sizes) +
                            ORIENTATIONS * SpatialModel::NUMBERS);
  const DecodedAnchors to(geometry, shape, sizes.hidden, weights);
  const auto two_layers = [&](int64_t first, int64_t hidden, int64_t last, FileLayer* layers) {
    layers[0] = weights.layer(first, hidden);
    layers[1] = weights.layer(hidden, last);
  };
  FileLayer context[2], slices[MOST_LIST + 2][2];
  two_layers(inputs, sizes.context_hidden, outputs, context);
  int64_t start = sizes.slices[0];
  for (int64_t i = 1; i < sizes.slices.count; ++i) {
    two_layers(start, sizes.slice_hidden, 2 * sizes.slices[i], slices[i]);
    start += sizes.slices[i];
  }
  for (int group = 1; group < GROUPS && sizes.refines; ++group)
    two_layers(start, sizes.slice_hidden, 2 * shape.width(group), slices[MOST_LIST + group - 1]);
  SpatialModel models[ORIENTATIONS];
  for (SpatialModel& model : models) model.take(weights);

  const Bytes rows = file.array("frame", FLOAT32, 7, 3);
  {
    const Blame blame("frame");
    for (int i = 0; i < 21; ++i)
      if (!__builtin_isfinite(float_at(rows.data + 4 * i))) refuse("holds values that are not finite");
  }
  {
    const Blame blame("networks");
    for (SpatialModel& model : models) model.convert();
  }
  const ExactTables tables = exact_tables(true);
  {
    const Bytes data = file.section("triplane");
    const Blame blame("triplane");
    planes.decode(data, models, tables);
  }
  IntegerNetwork network;
  Slices refining;
  {
    const Blame blame("networks");
    Buffer<double> units(outputs);
    put_units(shape, sizes.base_steps, units.data);
    network = IntegerNetwork(context, 2, units.data);
    for (int64_t i = 1; i < sizes.slices.count; ++i) refining.networks[i] = IntegerNetwork(slices[i], 2, nullptr);
    for (int group = 1; group < GROUPS && sizes.refines; ++group) {
      for (int64_t i = 0; i < 2 * shape.width(group); ++i) units[i] = 1 / sizes.base_steps[group];
      refining.further[group - 1] = IntegerNetwork(slices[MOST_LIST + group - 1], 2, units.data);
    }
  }

  AttributeDecoder attributes(file, geometry, shape, sizes.base_steps, tables, to);
  for (int64_t i = 1; i <= sizes.slices.count; ++i) attributes.add(numbered("features.", i));
  attributes.add("scalings");
  attributes.add("offsets");
  if (n > 0) {
    const Blame blame("frame");
    const Frame frame(rows, geometry);
    const int64_t most = attributes.block_rows();
    Buffer<int64_t> found(outputs * (n < most ? n : most));
    for (int64_t begin = 0; begin < n; begin += most) {
      const int64_t some = n - begin < most ? n - begin : most;
      predict(planes, frame, network, geometry.codes.data + 3 * begin, some, found.data);
      decode_block(attributes, sizes, refining, begin, some, found.data, outputs);
    }
  }
  attributes.finish();
}

}  // namespace swz
