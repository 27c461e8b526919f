// Codec `gsc-quant`: integers over ranges (docs/bitstream.md). All in float64, in the order of the page.
#include "columns.h"
#include "gaussian_files.h"
#include "model.h"
#include "points.h"

namespace swz {

namespace {

constexpr double LARGEST = 1e12;

struct Range {
  double low[3], high[3];

  float value(int axis, int64_t code, int64_t bits) const {
    const int64_t top = (int64_t{1} << bits) - 1;
    if (code == top) return static_cast<float>(high[axis]);
    return static_cast<float>(low[axis] + static_cast<double>(code) * ((high[axis] - low[axis]) / static_cast<double>(top)));
  }
};

// Numbers of one end of a range; false if they are not `count` of those that may stand there.
bool end_of(const Json* from, int count, double* to) {
  if (from == nullptr) return false;
  if (count == 1) return from->is_number() && (*to = from->number, true);
  if (from->kind != Json::ARRAY || from->length != count) return false;
  for (const Json* each = from->first; each != nullptr; each = each->next) {
    if (!each->is_number()) return false;
    *to++ = each->number;
  }
  return true;
}

Range range_of(const Container& file, const char* name) {
  const int axes = std::strcmp(name, "position") == 0 ? 3 : 1;
  const Json *ranges = file.value("ranges"), *stated = nullptr;
  if (ranges != nullptr && ranges->kind == Json::OBJECT) stated = ranges->find(name);
  Range found{};
  bool fits = stated != nullptr && stated->kind == Json::ARRAY && stated->length == 2 &&
              end_of(stated->first, axes, found.low) && end_of(stated->first->next, axes, found.high);
  for (int axis = 0; fits && axis < axes; ++axis)
    fits = __builtin_fabs(found.low[axis]) < LARGEST && __builtin_fabs(found.high[axis]) < LARGEST &&
           found.low[axis] < found.high[axis];
  if (!fits) refuse("the header has no range of ", name);
  return found;
}

}  // namespace

void decode_gsc_quant(Container& file) {
  const int64_t n = file.integer("num_gaussians", 0, UINT32_MAX), degree = file.integer("sh_degree", 0, 3);
  const int64_t position_bits = file.integer("position_bits", 4, 21), bits = file.integer("bits", 2, 20);
  const int64_t rest = (degree + 1) * (degree + 1) - 1;
  file.allow_what(4 * n * (14 + 3 * rest), grouped(n), " Gaussians");
  const Gaussians to(n, degree, 3);
  if (n == 0) return;
  const Range position = range_of(file, "position"), sh = range_of(file, "sh"), opacity = range_of(file, "opacity"),
              scale = range_of(file, "scale"), quaternion = range_of(file, "quaternion");
  {
    const Bytes data = file.section("position");
    const Blame blame("position");
    const Points points = octree(data, n);
    int64_t highest = 0;
    for (int64_t i = 0; i < points.codes.size; ++i)
      for (int axis = 0; axis < 3; ++axis) highest |= points.coordinate(i, axis);
    if (points.codes.size != n || highest >> position_bits)
      refuse("holds ", grouped(points.codes.size), " points on another grid, the header says ", grouped(n));
    for (int64_t i = 0; i < n; ++i)
      for (int axis = 0; axis < 3; ++axis)
        to.means[3 * i + axis] = position.value(axis, points.coordinate(i, axis), position_bits);
  }
  const auto put = [&](const char* section, int64_t width, const Range& range, float* values, int64_t stride) {
    const Bytes data = file.section(section);
    const Blame blame(section);
    Columns columns(data, n, width);
    Buffer<int64_t> codes(n);
    bool within = true;
    for (int64_t c = 0; c < width; ++c) {
      columns.next(codes.data);
      for (int64_t i = 0; i < n; ++i) {
        within &= codes[i] >= 0 && codes[i] >> bits == 0;
        values[stride * i + c] = range.value(0, codes[i], bits);
      }
    }
    columns.finish();
    if (!within) refuse("a code has more than ", bits, " bits");
  };
  static constexpr const char* BANDS[] = {"sh0", "sh1", "sh2", "sh3"};
  put(BANDS[0], 3, sh, to.sh_dc, 3);
  for (int64_t band = 1; band <= degree; ++band)
    put(BANDS[band], 3 * (2 * band + 1), sh, to.sh_rest + 3 * (band * band - 1), 3 * rest);
  put("opacity", 1, opacity, to.opacity_logits, 1);
  put("scaling", 3, scale, to.log_scales, 3);
  put("rotation", 4, quaternion, to.quats, 4);
}

}  // namespace swz
