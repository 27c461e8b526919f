// Codec `raht`: attributes under the region-adaptive hierarchical transform (docs/bitstream.md). All in float64, in the
// order of the page.
#include "arrays.h"
#include "columns.h"
#include "gaussian_files.h"
#include "model.h"
#include "points.h"

namespace swz {

namespace {

constexpr int CHANNELS = 7, LATTICES = 10;

// Of rows in blocks of about equal size: the block of each row.
struct Blocks {
  int64_t rows, blocks;
  int64_t of(int64_t row) const {
    const int64_t size = rows / blocks, larger = rows % blocks, border = larger * (size + 1);
    return row < border ? row / (size + 1) : larger + (row - border) / size;
  }
};

// Integers [rows, width] times the steps of their blocks, each a product in float32.
template <class Put>
void lattice(Container& file, const char* section, int64_t rows, int first, int width, int64_t blocks, int64_t bits,
             const Buffer<uint8_t>& steps, const Buffer<int64_t>& zeros, const Put& put) {
  const Bytes data = file.section(section);
  const Blame blame(section);
  const Blocks block{rows, blocks};
  Columns columns(data, rows, width);
  Buffer<int64_t> values(rows);
  bool within = true;
  for (int c = 0; c < width; ++c) {
    columns.next(values.data);
    for (int64_t i = 0; i < rows; ++i) {
      const int64_t at = block.of(i) * LATTICES + first + c, symbol = values[i] + zeros[at];
      within &= symbol >= 0 && symbol < int64_t{1} << bits;
      put(i, c, float_at(steps.data + 4 * at) * static_cast<float>(values[i]));
    }
  }
  columns.finish();
  if (!within) refuse("a symbol is outside of 0..", (int64_t{1} << bits) - 1);
}

int64_t lower_bound(const int64_t* codes, int64_t count, uint64_t wanted) {
  int64_t low = 0, high = count;
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (static_cast<uint64_t>(codes[middle]) < wanted) low = middle + 1;
    else high = middle;
  }
  return low;
}

// Coefficients [n, 7] become values, in place: merges from the highest bit down.
void inverse(const Buffer<int64_t>& codes, double* rows) {
  const int64_t n = codes.size;
  for (int bit = 62; bit >= 0; --bit)
    for (int64_t i = 1; i < n; ++i) {
      const auto code = static_cast<uint64_t>(codes[i]), differing = code ^ static_cast<uint64_t>(codes[i - 1]);
      if (differing >> bit != 1) continue;
      const int64_t left = lower_bound(codes.data, n, code >> (bit + 1) << (bit + 1));
      const int64_t end = lower_bound(codes.data, n, ((code >> bit) + 1) << bit);
      const auto w = static_cast<double>(i - left), v = static_cast<double>(end - i);
      const double a = __builtin_sqrt(w / (w + v)), b = __builtin_sqrt(v / (w + v));
      for (int c = 0; c < CHANNELS; ++c) {
        const double low = rows[CHANNELS * left + c], high = rows[CHANNELS * i + c];
        rows[CHANNELS * left + c] = a * low - b * high;
        rows[CHANNELS * i + c] = a * high + b * low;
      }
    }
}

void cosine_and_sine(double x, double& cosine, double& sine) {
  constexpr double HIGH = 1.5707963267341256, LOW = 6.077100506506192e-11;
  double factorial[20] = {1};
  for (int i = 1; i < 20; ++i) factorial[i] = factorial[i - 1] * i;
  const double quarter = __builtin_rint(x / (HIGH + LOW)), rest = (x - quarter * HIGH) - quarter * LOW, square = rest * rest;
  double c = 0, s = 0;
  for (int i = 9; i >= 0; --i) {
    const double sign = i % 2 ? -1.0 : 1.0;
    c = c * square + sign / factorial[2 * i];
    s = s * square + sign / factorial[2 * i + 1];
  }
  s = s * rest;
  const double turns = quarter - 4 * __builtin_floor(quarter / 4);
  const bool odd = turns == 1 || turns == 3;
  cosine = odd ? s : c;
  sine = odd ? c : s;
  if (turns == 1 || turns == 2) cosine = -cosine;
  if (turns >= 2) sine = -sine;
}

void put_quat(const double* angles, float* to) {
  double cx, sx, cy, sy, cz, sz;
  cosine_and_sine(angles[0] / 2, cx, sx);
  cosine_and_sine(angles[1] / 2, cy, sy);
  cosine_and_sine(angles[2] / 2, cz, sz);
  to[0] = static_cast<float>(cz * cy * cx + sz * sy * sx);
  to[1] = static_cast<float>(cz * cy * sx - sz * sy * cx);
  to[2] = static_cast<float>(cz * sy * cx + sz * cy * sx);
  to[3] = static_cast<float>(sz * cy * cx - cz * sy * sx);
}

void put_harmonics(Container& file, int64_t n, int64_t size, const Gaussians& to) {
  Buffer<int64_t> index(n);
  {
    const Bytes data = file.section("index");
    const Blame blame("index");
    Columns columns(data, n, 1);
    columns.next(index.data);
    columns.finish();
    for (int64_t i = 0; i < n; ++i)
      if (index[i] < 0 || index[i] >= size) refuse("an index leaves the codebook of ", grouped(size), " entries");
  }
  const Bytes data = file.section("codebook");
  const Blame blame("codebook");
  const int64_t width = 3 * to.rest;
  const Buffer<uint8_t> codebook = byte_planes(data, size, width, 2);
  for (int64_t i = 0; i < n; ++i)
    for (int64_t k = 0; k < width; ++k) to.sh_rest[width * i + k] = half(codebook.data + 2 * (width * index[i] + k));
}

}  // namespace

void decode_raht(Container& file) {
  const int64_t n = file.integer("num_gaussians", 0, INT32_MAX), degree = file.integer("max_sh_degree", 0, 3);
  file.integer("active_sh_degree", 0, degree);
  const int64_t depth = file.integer("depth", 1, 21), bits = file.integer("bits", 1, 16);
  const int64_t blocks = file.integer("blocks", 1, 4096), size = file.integer("codebook_size", 0, 1 << 16);
  const Json* anchor = file.value("anchor");
  if (anchor == nullptr || !(anchor->is("center") || anchor->is("corner")))
    refuse("header value 'anchor' must be one of center, corner");
  file.allow(4 * n * (11 + 3 * (degree + 1) * (degree + 1)), n);
  file.usual("entropy", "columns");
  file.usual("positions", "octree");
  const Gaussians to(n, degree, 3);
  double box[6];
  std::memcpy(box, file.array("box", FLOAT64, 2, 3).data, sizeof(box));
  for (const double side : box)
    if (!__builtin_isfinite(side)) {
      const Blame blame("box");
      refuse("holds values that are not finite");
    }
  const Points points = [&] {
    const Bytes data = file.section("positions");
    const Blame blame("positions");
    Points found = octree(data);
    int64_t distinct = found.codes.size > 0, highest = 0;
    for (int64_t i = 1; i < found.codes.size; ++i) distinct += found.codes[i] != found.codes[i - 1];
    if (found.codes.size != n || distinct != n)
      refuse("holds ", grouped(distinct), " voxels, header says ", grouped(n));
    const double offset = anchor->is("center") ? 0.5 : 0.0;
    for (int64_t i = 0; i < n; ++i)
      for (int axis = 0; axis < 3; ++axis) {
        const int64_t cell = found.coordinate(i, axis);
        highest |= cell;
        const double width = box[3 + axis] - box[axis];
        to.means[3 * i + axis] = static_cast<float>(
            box[axis] + (static_cast<double>(cell) + offset) * (width * (1.0 / static_cast<double>(int64_t{1} << depth))));
      }
    if (highest >> depth) refuse("a voxel leaves the grid of ", depth, " levels");
    return found;
  }();
  const Buffer<uint8_t> steps = [&] {
    const Bytes data = file.section("steps");
    const Blame blame("steps");
    return byte_planes(data, blocks, LATTICES, 4);
  }();
  Buffer<int64_t> zeros(blocks * LATTICES);
  {
    const Bytes data = file.section("zeros");
    const Blame blame("zeros");
    Columns columns(data, blocks, LATTICES);
    Buffer<int64_t> values(blocks);
    bool within = true;
    for (int c = 0; c < LATTICES; ++c) {
      columns.next(values.data);
      for (int64_t i = 0; i < blocks; ++i) {
        zeros[i * LATTICES + c] = values[i];
        within &= values[i] >= 0 && values[i] < int64_t{1} << bits;
      }
    }
    columns.finish();
    if (!within) refuse("a zero is no integer of ", bits, " bits");
  }
  const Bytes mean = file.array("mean", FLOAT32, CHANNELS);
  lattice(file, "scales", n, CHANNELS, 3, blocks, bits, steps, zeros,
          [&](int64_t i, int c, float value) { to.log_scales[3 * i + c] = value; });
  const int64_t others = n > 0 ? n - 1 : 0;
  Buffer<double> rows((others + 1) * CHANNELS);
  for (int c = 0; c < CHANNELS; ++c) rows[c] = float_at(mean.data + 4 * c);
  lattice(file, "detail", others, 0, CHANNELS, blocks, bits, steps, zeros,
          [&](int64_t i, int c, float value) { rows[CHANNELS * (i + 1) + c] = value; });
  inverse(points.codes, rows.data);
  if (degree) put_harmonics(file, n, size, to);
  for (int64_t i = 0; i < n; ++i) {
    const double* row = rows.data + CHANNELS * i;
    to.opacity_logits[i] = static_cast<float>(row[0]);
    put_quat(row + 1, to.quats + 4 * i);
    for (int color = 0; color < 3; ++color) to.sh_dc[3 * i + color] = static_cast<float>(row[4 + color]);
  }
  decoded.check_finite();
}

}  // namespace swz
