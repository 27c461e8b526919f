#include "anchors.h"

#include "arrays.h"
#include "model.h"
#include "points.h"

namespace swz {

namespace {

constexpr int64_t TOP = 65535, FIELDS = 12;

}  // namespace

const char* joined(const char* first, const char* second) {
  const size_t a = std::strlen(first), b = std::strlen(second);
  auto* text = static_cast<char*>(std::malloc(a + b + 1));
  if (text == nullptr) refuse("the decoder has no more memory");
  std::memcpy(text, first, a);
  std::memcpy(text + a, second, b + 1);
  return text;
}

IntegerList::IntegerList(const Container& file, const char* key, int64_t low, int64_t high, int64_t longest,
                         int64_t shortest) {
  const Json* list = file.value(key);
  bool fits = list != nullptr && list->kind == Json::ARRAY && list->length >= shortest && list->length <= longest;
  for (const Json* each = fits ? list->first : nullptr; each != nullptr; each = each->next) {
    fits &= each->kind == Json::INTEGER && each->integer >= low && each->integer <= high;
    values[count++] = each->integer;
    sum += each->integer;
  }
  if (fits) return;
  Text range;
  if (shortest < longest) {
    range.put(shortest);
    range.put("..");
  }
  range.put(longest);
  refuse("header value '", key, "' must be a list of ", range.data, " integers in ", low, "..", high);
}

void check_mode(const Container& file) {
  const Json* mode = file.value("mode");
  if (mode != nullptr && mode->is("exact")) return;
  if (mode == nullptr || !mode->is("float")) refuse("header value 'mode' must be one of exact, float");
  refuse("mode 'float' decodes only where it was encoded: encode with codec.settings.mode=exact");
}

void read_base_steps(const Container& file, double low, double high, const char* range, double* steps) {
  const Json* list = file.value("base_steps");
  bool fits = list != nullptr && list->kind == Json::ARRAY && list->length == GROUPS;
  for (const Json* each = fits ? list->first : nullptr; each != nullptr; each = each->next) {
    fits &= each->is_number() && each->number >= low && each->number <= high;
    *steps++ = each->number;
  }
  if (!fits) refuse("header value 'base_steps' must be three numbers in ", range);
}

void Geometry::read_counts(const Container& file, const Shape& shape) {
  count = file.integer("num_anchors", 0, UINT32_MAX);
  offsets = shape.offsets;
  gaussians = file.integer("num_gaussians", count, count * offsets);
  file.allow_what(count * shape.decoded_bytes(), "a model of ", grouped(count), " anchors");
}

void Geometry::read_bounds(Bytes& data) {
  if (data.left < 24) refuse("ends within the bounds of the anchors");
  bool fits = true;
  for (int axis = 0; axis < 3; ++axis) {
    const float from = float_at(data.data + 4 * axis), to = float_at(data.data + 12 + 4 * axis);
    fits &= __builtin_isfinite(from) && __builtin_isfinite(to) && from <= to;
    low[axis] = from;
    step[axis] = (double{to} - low[axis]) / TOP;
    if (!(step[axis] > 0)) step[axis] = 1e-6;
  }
  if (!fits) refuse("the bounds of the anchors are not finite or end before they start");
  data.take(24);
}

void Geometry::read_anchors(Bytes data) {
  read_bounds(data);
  const Points points = octree(data, count);
  if (points.codes.size != count) refuse("holds ", grouped(points.codes.size), " anchors, header says ", grouped(count));
  codes = Buffer<int64_t>(3 * count);
  positions = Buffer<float>(3 * count);
  bool leaves = false;
  for (int64_t i = 0; i < count; ++i)
    for (int axis = 0; axis < 3; ++axis) {
      const int64_t code = points.coordinate(i, axis);
      leaves |= code > TOP;
      codes[3 * i + axis] = code;
      positions[3 * i + axis] = static_cast<float>(static_cast<double>(code) * step[axis] + low[axis]);
    }
  if (leaves) refuse("an anchor leaves the lattice of 16 bits");
}

int64_t Geometry::code_of(float position, int axis) const {
  const double code = __builtin_floor((double{position} - low[axis]) / step[axis]);
  return code < 0 ? 0 : code > TOP ? TOP : static_cast<int64_t>(code);
}

void Geometry::read_voxels(Bytes data) {
  constexpr int64_t LARGEST = 1 << 30;
  read_bounds(data);
  if (data.left < 20) refuse("ends within the lattice of the positions");
  double edge;
  std::memcpy(&edge, data.take(8).data, 8);
  int64_t lowest[3];
  for (auto& each : lowest) each = static_cast<int32_t>(data.integer(4));
  if (!(edge > 1e-30 && edge < 1e30)) refuse("the voxel size is no positive number");
  const Points points = octree(data, count);
  if (points.codes.size != count) refuse("holds ", grouped(points.codes.size), " anchors, header says ", grouped(count));
  codes = Buffer<int64_t>(3 * count);
  positions = Buffer<float>(3 * count);
  bool leaves = false, finite = true;
  for (int64_t i = 0; i < count; ++i)
    for (int axis = 0; axis < 3; ++axis) {
      const int64_t at = 3 * i + axis, place = points.coordinate(i, axis) + lowest[axis];
      leaves |= place >= LARGEST || place <= -LARGEST;
      positions[at] = static_cast<float>(static_cast<double>(place) * edge);
      finite &= __builtin_isfinite(positions[at]);
      codes[at] = code_of(positions[at], axis);
    }
  if (leaves) refuse("an anchor leaves the lattice");
  if (!finite) refuse("the voxel size puts an anchor beyond all finite positions");
}

void Geometry::read_masks(Container& file) {
  const Bytes data = file.section("masks");
  const Blame blame("masks");
  Buffer<int32_t> bits(count * offsets);
  bernoulli(data, bits.size, bits.data);
  masks = Buffer<uint8_t>(3 * bits.size);
  int64_t kept = 0;
  bool any = true;
  for (int64_t i = 0; i < count; ++i) {
    int64_t own = 0;
    for (int64_t j = i * offsets; j < (i + 1) * offsets; ++j) {
      own += bits[j];
      for (int axis = 0; axis < 3; ++axis) masks[3 * j + axis] = static_cast<uint8_t>(bits[j]);
    }
    kept += own;
    any &= own > 0;
  }
  if (kept != gaussians) refuse("keeps ", grouped(kept), " Gaussians, header says ", grouped(gaussians));
  if (!any) refuse("an anchor has no Gaussian");
}

int64_t networks_of_anchors(const Shape& shape, int64_t hidden) {
  return 3 * (shape.features + 5) * hidden + 11 * (hidden + 1) * shape.offsets;
}

DecodedAnchors::DecodedAnchors(const Geometry& geometry, const Shape& shape, int64_t hidden, Weights& weights) {
  static constexpr int OUTPUTS[3] = {1, 7, 3}, BY_NAME[3] = {2, 1, 0};
  static constexpr const char* PARTS[4] = {".0.bias", ".0.weight", ".2.bias", ".2.weight"};
  const int64_t n = geometry.count, inputs = shape.features + 4;
  FileLayer layers[3][2];
  for (int i = 0; i < 3; ++i) {
    layers[i][0] = weights.layer(inputs, hidden);
    layers[i][1] = weights.layer(hidden, OUTPUTS[i] * shape.offsets);
  }
  std::memcpy(decoded.add("anchors", n, 3), geometry.positions.data, static_cast<size_t>(FIELDS * n));
  features = decoded.add("features", n, shape.features);
  for (const int i : BY_NAME)
    for (int part = 0; part < 4; ++part) {
      const FileLayer& layer = layers[i][part / 2];
      const bool is_bias = part % 2 == 0;
      const int64_t size = layer.outputs * (is_bias ? 1 : layer.inputs);
      float* values = decoded.add(joined(NETWORKS[i], PARTS[part]), layer.outputs,
                                  is_bias ? -1 : layer.inputs);
      std::memcpy(values, is_bias ? layer.bias : layer.weights, static_cast<size_t>(4 * size));
    }
  offsets = decoded.add("offsets", n, shape.offsets, 3);
  scales = decoded.add("scales", n, 6);
  uint32_t* masks = decoded.add_index("masks", n * shape.offsets);
  for (int64_t i = 0; i < n * shape.offsets; ++i) masks[i] = geometry.masks[3 * i];
}

void put_units(const Shape& shape, const double* base_steps, double* units) {
  for (int group = 0; group < GROUPS; ++group)
    for (int64_t i = 0; i < 2 * shape.width(group); ++i) *units++ = 1 / base_steps[group];
  for (int group = 0; group < GROUPS; ++group) *units++ = 1;
}

const char* numbered(const char* name, int64_t number) {
  Text digits;
  digits.put(number);
  return joined(name, digits.data);
}

void AttributeDecoder::begin(int64_t n, const int64_t* outputs, int64_t stride, int64_t offset) {
  for (int group = 0; group < GROUPS; ++group) {
    step[group] = Buffer<double>(n);
    multiplier[group] = Buffer<int64_t>(n);
    const double unit = base_steps[group] / 4096;
    for (int64_t i = 0; i < n; ++i) {
      multiplier[group][i] = rows.tables.multiplier(outputs[i * stride + group]) + offset;
      step[group][i] = static_cast<double>(multiplier[group][i]) * unit;
    }
  }
}

Destination AttributeDecoder::destination(int group, int64_t first, int64_t column) const {
  const int64_t width = shape.width(group);
  return {to.group(group) + first * width + column, width, step[group].data, multiplier[group].data};
}

void AttributeDecoder::gaussians(int section, int group, int64_t first, int64_t n, int64_t column, int64_t columns,
                                 Integers mean, Integers scale, int64_t* integers, int64_t integers_stride) {
  Blocks& blocks = sections[section];
  const Blame blame(blocks.name);
  Destination into = destination(group, first, column);
  into.integers = integers, into.integers_stride = integers_stride;
  const uint8_t* present = group == 2 ? geometry.masks.data + 3 * geometry.offsets * first : nullptr;
  rows.gaussians(blocks.left.take(blocks.left.length()), {n, columns, present}, mean, scale, into);
}

void AttributeDecoder::mixtures(int section, int64_t first, int64_t n, int64_t column, int64_t columns,
                                const Mixture& of, int64_t* integers, int64_t integers_stride) {
  Blocks& blocks = sections[section];
  const Blame blame(blocks.name);
  Destination into = destination(0, first, column);
  into.integers = integers, into.integers_stride = integers_stride;
  rows.mixtures(blocks.left.take(blocks.left.length()), {n, columns}, of, into);
}

void AttributeDecoder::finish() const {
  for (int64_t i = 0; i < count; ++i) {
    const Blame blame(sections[i].name);
    sections[i].left.finish();
  }
}

}  // namespace swz
