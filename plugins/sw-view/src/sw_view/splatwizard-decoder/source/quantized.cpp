// Gaussians on a lattice: positions by `octree`, all else by `columns` (docs/bitstream.md, 3dgs, quantized).
//
// What a column decodes to goes into the model at once: no matrix of all integers is ever in memory. All arithmetic is
// that of the page, float64 in the order written.
#include <algorithm>

#include "columns.h"
#include "gaussian_files.h"
#include "model.h"
#include "points.h"
#include "quantized.h"

namespace swz {

namespace {

// Header values that a method keeps beside those of the codec.
constexpr const char* BESIDE[] = {"entropy", "positions", "mode", "codec", "method", "depth_ratio", "lambda_dist",
                                  "lambda_normal", "world_origin"};
constexpr const char* KEYS[] = {"num_gaussians", "max_sh_degree", "active_sh_degree", "position_bits", "center",
                                "width", "top", "dc_step", "rest_step", "opacity_step", "scale_step", "quat_step",
                                "sh_classes", "precision", "sh_basis", "primitive", "packets"};

constexpr int MOST_PRECISION = 4;
constexpr double BASIS_UNIT = 127;

constexpr int64_t MOST_PACKETS = 64;

// Rows of the packets that are read.
struct Packets {
  int64_t count = 0, rows[MOST_PACKETS];
  double swell = 0;  // what the last of them adds to log scales
};

}  // namespace

[[noreturn]] void wrong(const char* key, const char* reason) { refuse("header value '", key, "': ", reason); }

const Json* stated(const Container& file, const char* key) {
  const Json* found = file.value(key);
  if (found == nullptr) wrong(key, "Field required");
  return found;
}

int64_t stated_integer(const Container& file, const char* key, int64_t low, int64_t high) {
  const Json* found = stated(file, key);
  if (found->kind != Json::INTEGER) wrong(key, "Input should be a valid integer");
  if (found->integer < low)
    refuse("header value '", key, "': Input should be greater than or equal to ", low);
  if (found->integer > high) {
    if (high == UINT32_MAX) wrong(key, "Input should be less than 4294967296");
    refuse("header value '", key, "': Input should be less than or equal to ", high);
  }
  return found->integer;
}

namespace {

double step(const Container& file, const char* key) {
  const Json* found = stated(file, key);
  if (!found->is_number()) wrong(key, "Input should be a valid number");
  if (!(found->number > 0)) wrong(key, "Input should be greater than 0");
  if (!(found->number <= 1000)) wrong(key, "Input should be less than or equal to 1000");
  return found->number;
}

bool flag(const Container& file, const char* key) {
  const Json* found = file.value(key);
  if (found == nullptr || found->kind == Json::NOTHING) return false;
  if (found->kind != Json::YES) wrong(key, "Input should be True");
  return true;
}

void three(const Container& file, const char* key, bool integers, double* to) {
  const Json* found = stated(file, key);
  if (found->kind != Json::ARRAY) wrong(key, "Input should be a valid tuple");
  const Json* each = found->first;
  for (int i = 0; i < 3; ++i, each = each->next) {
    Text place;
    place.put(key), place.put("."), place.put(int64_t{i});
    if (each == nullptr) wrong(place.data, "Field required");
    if (integers && each->kind != Json::INTEGER) wrong(place.data, "Input should be a valid integer");
    if (!each->is_number()) wrong(place.data, "Input should be a valid number");
    to[i] = each->number;
  }
  if (found->length > 3)
    refuse("header value '", key, "': Tuple should have at most 3 items after validation, not ",
           static_cast<int64_t>(found->length));
}

// Rows [n, g] of `packets`, which fit the cuts of the file. A file without packets is one of its own.
Packets packets_of(const Container& file, int64_t gaussians) {
  Packets found;
  const Json* rows = file.value("packets");
  const bool stated = rows != nullptr && rows->kind != Json::NOTHING;
  int64_t all = 0, sum = 0;
  if (stated) {
    if (rows->kind != Json::ARRAY) wrong("packets", "Input should be a valid list");
    if (rows->length < 1) wrong("packets", "List should have at least 1 item after validation, not 0");
    if (rows->length > MOST_PACKETS) wrong("packets", "List should have at most 64 items after validation");
    for (const Json* row = rows->first; row != nullptr; row = row->next, ++all) {
      const Json* number = row->first;
      if (row->kind != Json::ARRAY || row->length != 2 || number->kind != Json::INTEGER || !number->next->is_number() ||
          number->integer < 0 || number->integer > UINT32_MAX || !(number->next->number >= 0 && number->next->number <= 10))
        wrong("packets", "Input should be rows of a packet and what it adds to log scales");
      sum += number->integer;
      if (all >= file.packets) continue;
      found.rows[found.count++] = number->integer;
      found.swell = number->next->number;
    }
  }
  if (all != file.cuts || (stated && sum != gaussians)) refuse("cuts, packets and their Gaussians do not fit together");
  if (!stated) found.rows[found.count++] = gaussians;
  return found;
}

}  // namespace

Layout::Layout(const Container& file, std::initializer_list<const char*> further) {
  count = stated_integer(file, "num_gaussians", 0, UINT32_MAX);
  degree = stated_integer(file, "max_sh_degree", 0, 3);
  active = stated_integer(file, "active_sh_degree", 0, 3);
  bits = stated_integer(file, "position_bits", 1, 21);
  three(file, "center", false, center);
  three(file, "width", false, width);
  three(file, "top", true, top);
  dc_step = step(file, "dc_step");
  rest_step = step(file, "rest_step");
  opacity_step = step(file, "opacity_step");
  scale_step = step(file, "scale_step");
  quat_step = step(file, "quat_step");
  classes = stated_integer(file, "sh_classes", 1, 16);
  precision = flag(file, "precision");
  basis = nullptr;
  const Json* primitive = file.value("primitive");
  if (primitive != nullptr && primitive->kind != Json::NOTHING && !primitive->is("surfel"))
    wrong("primitive", "Input should be 'surfel'");
  scales = primitive != nullptr && primitive->kind == Json::STRING ? 2 : 3;
  for (const Json* key = file.header->find("static")->first; key != nullptr; key = key->next) {
    const auto same = [&](const char* name) { return std::strcmp(name, key->key) == 0; };
    if (std::none_of(BESIDE, std::end(BESIDE), same) && std::none_of(KEYS, std::end(KEYS), same) &&
        std::none_of(further.begin(), further.end(), same))
      wrong(key->key, "Extra inputs are not permitted");
  }
  file.usual("entropy", "columns");
  file.usual("positions", "octree");
}

void Layout::check() const {
  if (active > degree) refuse("header activates more SH bands than there are");
  for (int axis = 0; axis < 3; ++axis)
    if (!(width[axis] > 0 && width[axis] < 1e30 && top[axis] >= 1 && top[axis] <= 40))
      refuse("header describes no usable position grid");
}

namespace {

// The coordinate of a cell on an axis.
double coordinate(const Layout& layout, int axis, int64_t cell) {
  const double top = layout.top[axis];
  const double v = (static_cast<double>(cell) + 0.5) * (2 * top * (1.0 / static_cast<double>(int64_t{1} << layout.bits))) - top;
  const double a = __builtin_fabs(v);
  double u = a;
  if (!(a < 1.0)) {
    const double octave = __builtin_floor(a);
    u = (1.0 + (a - octave)) * static_cast<double>(int64_t{1} << (static_cast<int64_t>(octave) - 1));
  }
  return __builtin_copysign(u, v) * layout.width[axis] + layout.center[axis];
}

void put_means(const Layout& layout, const Points& points, const Coarse& coarse, float* means) {
  for (int64_t i = 0; i < layout.count; ++i)
    for (int axis = 0; axis < 3; ++axis)
      means[3 * i + axis] = static_cast<float>(
          coordinate(layout, axis, coarse.cell(points.coordinate(i, axis), axis, i, layout.count)));
}

// A column of integers that must not be beyond 2^30; what is, is refused once the whole matrix is known to be sound.
struct Matrix {
  Columns columns;
  Buffer<int64_t> values;
  bool beyond = false;

  Matrix(Bytes data, int64_t rows, int64_t width) : columns(data, rows, width), values(rows) {}
  const int64_t* next() {
    columns.next(values.data);
    for (int64_t i = 0; i < columns.rows; ++i) beyond |= values[i] < -MAX_SYMBOL || values[i] > MAX_SYMBOL;
    return values.data;
  }
  void finish() {
    columns.finish();
    if (beyond) refuse("a quantised value is beyond 2^30");
  }
};

const double A = 1 / __builtin_sqrt(3.0), B = 1 / __builtin_sqrt(2.0), C = 1 / __builtin_sqrt(6.0),
             D = -2 / __builtin_sqrt(6.0);

// Rows of a matrix in the model, and the factors of their steps; null: all rows in order, and 1.
struct Rows {
  const uint32_t* numbers;
  const double* factors;
  const Coarse& coarse;
  int64_t count;  // of the packet

  // A symbol of the layout for that of a column.
  int64_t fine(int64_t symbol, int64_t column, int64_t i) const { return coarse.symbol(symbol, column, row(i), count); }
  int64_t row(int64_t i) const { return numbers == nullptr ? i : numbers[i]; }
  double step(double step, int64_t i) const { return factors == nullptr ? step : step * factors[row(i)]; }
};

// The next two columns of three; the third is what `matrix.next()` returns afterwards.
struct Two {
  Buffer<int32_t> columns[2];

  explicit Two(Matrix& matrix) : columns{Buffer<int32_t>(matrix.columns.rows), Buffer<int32_t>(matrix.columns.rows)} {
    for (auto& column : columns) {
      const int64_t* values = matrix.next();
      for (int64_t i = 0; i < matrix.columns.rows; ++i) column[i] = static_cast<int32_t>(values[i]);
    }
  }
};

// Where the columns of a section go: row i of a matrix to to[stride * rows.row(i)], its sum of magnitudes to activity.
struct Target {
  void (*put)(Matrix& matrix, const Target& target, const Rows& rows);
  double step;
  float* to;
  int64_t stride;
  int64_t column;  // the first, of those of all attributes
  int64_t* activity = nullptr;
};

// Colours, each of three columns: luma, red-blue and green-magenta.
void put_colors(Matrix& matrix, const Target& target, const Rows& rows) {
  for (int64_t c = 0; c < matrix.columns.width; c += 3) {
    const Two symbols(matrix);
    const int64_t* last = matrix.next();
    for (int64_t i = 0; i < matrix.columns.rows; ++i) {
      const double s = rows.step(target.step, i);
      const int64_t at = target.column + c;
      const double y = static_cast<double>(rows.fine(symbols.columns[0][i], at, i)) * s,
                   u = static_cast<double>(rows.fine(symbols.columns[1][i], at + 1, i)) * s,
                   v = static_cast<double>(rows.fine(last[i], at + 2, i)) * s;
      float* rgb = target.to + target.stride * rows.row(i) + c;
      rgb[0] = static_cast<float>(A * y + B * u + C * v);
      rgb[1] = static_cast<float>(A * y + 0.0 * u + D * v);
      rgb[2] = static_cast<float>(A * y + -B * u + C * v);
      if (target.activity != nullptr)
        target.activity[rows.row(i)] += std::abs(int64_t{symbols.columns[0][i]}) +
                                        std::abs(int64_t{symbols.columns[1][i]}) + std::abs(last[i]);
    }
  }
}

void put_columns(Matrix& matrix, const Target& target, const Rows& rows) {
  for (int64_t c = 0; c < matrix.columns.width; ++c) {
    const int64_t* values = matrix.next();
    for (int64_t i = 0; i < matrix.columns.rows; ++i)
      target.to[target.stride * rows.row(i) + c] = static_cast<float>(
          static_cast<double>(rows.fine(values[i], target.column + c, i)) * rows.step(target.step, i));
  }
}

void put_quats(Matrix& matrix, const Target& target, const Rows& rows) {
  const double coarsest = target.step > 0.5 ? target.step : 0.5;
  const Two symbols(matrix);
  const int64_t* last = matrix.next();
  for (int64_t i = 0; i < matrix.columns.rows; ++i) {
    const double own = rows.step(target.step, i), s = own < coarsest ? own : coarsest;
    const double x = static_cast<double>(rows.fine(symbols.columns[0][i], target.column, i)) * s,
                 y = static_cast<double>(rows.fine(symbols.columns[1][i], target.column + 1, i)) * s,
                 z = static_cast<double>(rows.fine(last[i], target.column + 2, i)) * s;
    const double squared = x * x + y * y + z * z;
    const double w = __builtin_sqrt(1.0 - squared > 0.0 ? 1.0 - squared : 0.0);
    const double norm = __builtin_sqrt(squared > 1.0 ? squared : 1.0);
    float* quat = target.to + target.stride * rows.row(i);
    quat[0] = static_cast<float>(w / norm);
    quat[1] = static_cast<float>(x / norm);
    quat[2] = static_cast<float>(y / norm);
    quat[3] = static_cast<float>(z / norm);
  }
}

// Columns of SH in a basis of their own: integers, where their values will be.
void put_integers(Matrix& matrix, const Target& target, const Rows& rows) {
  for (int64_t c = 0; c < matrix.columns.width; ++c) {
    const int64_t* values = matrix.next();
    for (int64_t i = 0; i < matrix.columns.rows; ++i) {
      const auto value = static_cast<int32_t>(values[i]);
      std::memcpy(target.to + target.stride * rows.row(i) + c, &value, 4);
      target.activity[rows.row(i)] += std::abs(values[i]);
    }
  }
}

// The integers of each row become its coefficients. Sums are exact: a product is below 2^37.
void from_basis(const Layout& layout, const double* factors, const Gaussians& to) {
  const int64_t width = 3 * ((layout.active + 1) * (layout.active + 1) - 1);
  for (int64_t i = 0; i < layout.count; ++i) {
    float* row = to.sh_rest + 3 * to.rest * i;
    double sums[45] = {};
    for (int64_t j = 0; j < width; ++j) {
      int32_t symbol;
      std::memcpy(&symbol, row + j, 4);
      if (symbol == 0) continue;
      for (int64_t k = 0; k < width; ++k) sums[k] += static_cast<double>(symbol) * layout.basis[width * j + k];
    }
    const double step = layout.rest_step / BASIS_UNIT, s = factors == nullptr ? step : step * factors[i];
    for (int64_t k = 0; k < width; ++k) row[k] = static_cast<float>(sums[k] * s);
  }
}

// The class of each row by its activity, the rows being cut into `count` parts of about equal size.
Buffer<uint8_t> classes_of(const Buffer<int64_t>& activity, int64_t count) {
  Buffer<uint8_t> classes(activity.size);
  classes.clear();
  if (count == 1 || activity.size == 0) return classes;
  Buffer<int64_t> ordered(activity.size);
  std::memcpy(ordered.data, activity.data, sizeof(int64_t) * static_cast<size_t>(activity.size));
  for (int64_t i = 1; i < count; ++i) {
    int64_t* limit = ordered.data + activity.size * i / count;
    std::nth_element(ordered.data, limit, ordered.data + activity.size);
    const int64_t reached = *limit;
    for (int64_t row = 0; row < activity.size; ++row) classes[row] += activity[row] >= reached;
  }
  return classes;
}

// A section whose rows are in classes by some values, each class a matrix of its own.
void put_classes(Bytes data, const Buffer<int64_t>& values, int64_t count, int64_t width, const double* factors,
                 const Target& target, const Coarse& coarse) {
  const int64_t n = values.size;
  const Buffer<uint8_t> classes = classes_of(values, count);
  if (data.left < 4 * count) refuse(data.left, " bytes cannot hold the lengths of ", count, " classes");
  const int64_t size = data.left;
  int64_t lengths[16], sum = 4 * count;
  for (int64_t k = 0; k < count; ++k) sum += lengths[k] = static_cast<int64_t>(data.integer(4));
  if (sum != size) refuse(grouped(size), " bytes, the class lengths say ", grouped(sum));
  Buffer<uint32_t> rows(n);
  for (int64_t k = 0; k < count; ++k) {
    int64_t found = 0;
    for (int64_t i = 0; i < n; ++i)
      if (classes[i] == k) rows[found++] = static_cast<uint32_t>(i);
    if ((found == 0) != (lengths[k] == 0))
      refuse("class ", k, " has ", grouped(found), " rows, but ", grouped(lengths[k]), " bytes");
    const Bytes part = data.take(lengths[k]);
    if (found == 0) continue;
    Matrix matrix(part, found, width);
    target.put(matrix, target, Rows{rows.data, factors, coarse, n});
    matrix.finish();
  }
}

}  // namespace

void Coarse::read(Container& file, const char* section, int64_t rows, int64_t width) {
  const Bytes data = file.section(section);
  const Blame blame(section);
  lacking = true;
  columns = Buffer<int16_t>((3 + width) * rows);
  Matrix matrix(data, rows, 3 + width);
  bool wide = false, beyond = false;
  for (int64_t c = 0; c < 3 + width; ++c) {
    const int64_t* values = matrix.next();
    for (int64_t i = 0; i < rows; ++i) {
      if (c < 3)
        wide |= values[i] < 0 || values[i] >> raw;
      else
        beyond |= std::abs(values[i]) > times / 2;
      columns[c * rows + i] = static_cast<int16_t>(values[i]);
    }
  }
  matrix.finish();
  if (wide) refuse("a coordinate has more than ", raw, " bits");
  if (beyond) refuse("a value is beyond ", times / 2);
}

void decode_rows(Container& file, const Layout& layout, const char* prefix, Gaussians to, const Coarse& coarse) {
  const int64_t n = layout.count, bits = layout.bits - coarse.raw;
  const auto section_of = [&](const char* name, const auto& decode) {
    Text whole;
    whole.put(prefix), whole.put(name);
    const Bytes data = file.section(whole.data);
    const Blame blame(whole.data);
    decode(data);
  };
  section_of("positions", [&](Bytes data) {
    const Points points = octree(data);
    if (points.codes.size != n) refuse("holds ", grouped(points.codes.size), " points, header says ", grouped(n));
    if (n && points.bits > bits) {
      int64_t highest = 0;
      for (int64_t i = 0; i < n; ++i)
        for (int axis = 0; axis < 3; ++axis) highest |= points.coordinate(i, axis);
      if (highest >> bits) refuse("a point leaves the grid of ", bits, " bits");
    }
    put_means(layout, points, coarse, to.means);
  });
  Buffer<int64_t> precision(layout.precision ? n : 0);
  Buffer<double> factors(precision.size);
  if (layout.precision)
    section_of("precision", [&](Bytes data) {
      Matrix matrix(data, n, 1);
      const int64_t* values = matrix.next();
      matrix.finish();
      for (int64_t i = 0; i < n; ++i) {
        const int64_t k = values[i];
        if (k < -MOST_PRECISION || k > MOST_PRECISION) refuse("a class of precision is beyond ", MOST_PRECISION);
        precision[i] = k;
        factors[i] = power_of_two(static_cast<int>(-(k >> 1))) * (k & 1 ? 0.7071067811865476 : 1.0);
      }
    });
  const double* steps = layout.precision ? factors.data : nullptr;
  Buffer<int64_t> activity(n);
  activity.clear();
  struct Part {
    const char* name;
    int64_t width;
    Target target;
  };
  const auto put_sh = layout.basis != nullptr ? put_integers : put_colors;
  const auto sh = [&](const char* name, int64_t band) {
    return Part{name, 3 * (2 * band + 1),
                {put_sh, layout.rest_step, to.sh_rest + 3 * (band * band - 1), 3 * to.rest,
                 7 + layout.scales + 3 * (band * band - 1), activity.data}};
  };
  const Part parts[] = {{"color", 3, {put_colors, layout.dc_step, to.sh_dc, 3, 0}},
                        {"opacity", 1, {put_columns, layout.opacity_step, to.opacity_logits, 1, 3}},
                        {"scales", layout.scales, {put_columns, layout.scale_step, to.log_scales, layout.scales, 4}},
                        {"quats", 3, {put_quats, layout.quat_step, to.quats, 4, 4 + layout.scales}},
                        sh("sh1", 1), sh("sh2", 2), sh("sh3", 3)};
  for (int i = 0; i < 4 + layout.active; ++i)
    section_of(parts[i].name, [&](Bytes data) {
      const Part& part = parts[i];
      if (i > 4) return put_classes(data, activity, layout.classes, part.width, steps, part.target, coarse);
      if (layout.precision) return put_classes(data, precision, layout.classes, part.width, steps, part.target, coarse);
      if (i == 4) return put_classes(data, activity, 1, part.width, steps, part.target, coarse);
      Matrix matrix(data, n, part.width);
      part.target.put(matrix, part.target, Rows{nullptr, nullptr, coarse, n});
      matrix.finish();
    });
  if (layout.basis != nullptr) from_basis(layout, steps, to);
}

void decode_quantized(Container& file) {
  Layout layout(file);
  const Packets packets = packets_of(file, layout.count);
  layout.check();
  int64_t n = 0;
  for (int64_t i = 0; i < packets.count; ++i) n += packets.rows[i];
  file.allow(layout.decoded_bytes(n), n);
  if (flag(file, "sh_basis")) {
    const Bytes data = file.section("basis");
    const Blame blame("basis");
    const int64_t width = 3 * ((layout.active + 1) * (layout.active + 1) - 1);
    if (data.left != width * width)
      refuse(grouped(data.left), " bytes, a basis of ", width, " coefficients has ", grouped(width * width));
    layout.basis = reinterpret_cast<const int8_t*>(data.data);
  }
  const Gaussians whole(n, layout.degree, layout.scales);
  Gaussians part = whole;
  for (int64_t i = 0; i < packets.count; ++i) {
    layout.count = packets.rows[i];
    Text prefix;
    if (file.cuts) prefix.put(i + 1), prefix.put("/");
    decode_rows(file, layout, prefix.data, part);
    part.advance(layout.count, layout.scales);
  }
  const auto swell = static_cast<float>(packets.swell);
  for (int64_t i = 0; i < n * layout.scales; ++i) whole.log_scales[i] += swell;
  decoded.check_finite();
}

}  // namespace swz
