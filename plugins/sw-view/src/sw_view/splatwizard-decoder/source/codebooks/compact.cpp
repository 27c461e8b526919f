// The files of `compact3dgs` (docs/bitstream.md): shapes by `residual-vq`, and the field that has the colours.
#include "arrays.h"
#include "categorical.h"
#include "color_field.h"
#include "gaussian_files.h"
#include "model.h"
#include "residual.h"

namespace swz {

namespace {

constexpr float SMALLEST_SCALE = 1e-8f;
constexpr int64_t MOST_ZERO = 1 << 23;

Buffer<float> halves_of(Container& file, const char* section, int64_t first, int64_t second = -1) {
  const Bytes data = file.array(section, FLOAT16, first, second);
  const Blame blame(section);
  Buffer<float> found(data.left / 2);
  for (int64_t i = 0; i < found.size; ++i) found[i] = half(data.data + 2 * i);
  check_finite(found.data, found.size);
  return found;
}

// The values of 256 symbols; refuses what is not finite.
template <class Value>
void lattice(float (&points)[256], const Value& value) {
  for (int i = 0; i < 256; ++i) points[i] = value(i);
  for (const float point : points)
    if (!__builtin_isfinite(point)) refuse("a decoded value is not finite in float32");
}

void check_side(const char* name, double value, bool positive) {
  if (__builtin_isfinite(value) && (!positive || value > 0)) return;
  refuse("side information '", name, "' is not finite", positive ? " and positive" : "");
}

void put_opacities(Bytes data, Coder coder, int64_t n, float* to) {
  if (data.left < 8) refuse("is ", data.left, " bytes, too few for its range");
  const double low = float_at(data.data), step = float_at(data.data + 4);
  data.take(8);
  check_side("low", low, false);
  check_side("step", step, true);
  float points[256];
  lattice(points, [&](int i) { return static_cast<float>(low + i * step); });
  Buffer<uint32_t> symbols(n);
  categorical(data, 256, n, symbols.data, {}, coder);
  for (int64_t i = 0; i < n; ++i) to[i] = points[symbols[i]];
}

void put_grid(Bytes data, Coder coder, const ColorField& field, float* to) {
  if (data.left < 8) refuse("is ", data.left, " bytes, too few for its scale");
  const float scale = float_at(data.data);
  const auto zero = static_cast<int32_t>(Bytes{data.data + 4, 4}.integer(4));
  data.take(8);
  check_side("scale", scale, true);
  if (zero < -MOST_ZERO || zero > MOST_ZERO) refuse("side information 'zero' is outside ", -MOST_ZERO, "..", MOST_ZERO);
  float points[256];
  lattice(points, [&](int i) { return scale * static_cast<float>(i - zero); });
  int64_t ends[MOST_LEVELS];
  for (int64_t l = 0; l < field.levels; ++l)
    ends[l] = (field.level[l].first + field.level[l].entries) * field.features;
  auto* symbols = reinterpret_cast<uint32_t*>(to);  // where their values will be
  categorical(data, 256, ends[field.levels - 1], symbols, {field.levels, ends}, coder);
  for (int64_t i = 0; i < ends[field.levels - 1]; ++i) {
    uint32_t symbol;
    std::memcpy(&symbol, to + i, 4);
    to[i] = points[symbol];
  }
}

}  // namespace

void decode_compact(Container& file) {
  const int64_t n = file.integer("num_gaussians", 1, UINT32_MAX);
  const Json *form = file.value("form"), *named = file.value("coder");
  if (form == nullptr || !(form->is("plain") || form->is("post-processed")))
    refuse("header value 'form' must be one of plain, post-processed");
  const bool processed = form->is("post-processed");
  const Coder coder = named != nullptr && named->kind == Json::STRING ? coder_of(named->text) : Coder::NONE;
  if (coder == Coder::NONE) refuse("header value 'coder' must be one of huffman, range, rans");
  color_field = ColorField(file);
  const ColorField& field = color_field;
  const int64_t numbers = field.entries * field.features;
  file.allow_what(4 * (n * (11 + field.width()) + numbers), grouped(n), " Gaussians and a grid of ", grouped(numbers),
                  " numbers");
  // In the order of the hash: means and quaternions, then by name.
  float* means = decoded.add("means", n, 3);
  float* quats = decoded.add("quats", n, 4);
  float* grid = decoded.add("color.grid.table", field.entries, field.features);
  float* layers[3] = {decoded.add("color.layers.0.weight", field.hidden, field.inputs()),
                      decoded.add("color.layers.1.weight", field.hidden, field.hidden),
                      decoded.add("color.layers.2.weight", 3, field.hidden)};
  float* opacities = decoded.add("opacities", n);
  float* scales = decoded.add("scales", n, 3);
  const auto copy = [](const float* from, int64_t count, float* to) {
    std::memcpy(to, from, sizeof(float) * static_cast<size_t>(count));
  };
  if (processed) {
    {
      const Bytes data = file.section("positions");
      const Blame blame("positions");
      copy(finite_halves(byte_planes(data, n, 3, 2)).data, 3 * n, means);
    }
    const Bytes data = file.section("opacities");
    const Blame blame("opacities");
    put_opacities(data, coder, n, opacities);
  } else {
    copy(halves_of(file, "positions", n, 3).data, 3 * n, means);
    copy(halves_of(file, "opacities", n).data, n, opacities);
  }
  const Buffer<float> weights = halves_of(file, "network", field.weights());
  const int64_t sizes[3] = {field.hidden * field.inputs(), field.hidden * field.hidden, 3 * field.hidden};
  for (int64_t i = 0, at = 0; i < 3; at += sizes[i++]) copy(weights.data + at, sizes[i], layers[i]);
  copy(residual_vq(file, {"scales/header", "scales/codebooks", "scales/indices"}, n, 3).data, 3 * n, scales);
  copy(residual_vq(file, {"rotations/header", "rotations/codebooks", "rotations/indices"}, n, 4).data, 4 * n, quats);
  if (processed) {
    const Bytes data = file.section("grid");
    const Blame blame("grid");
    put_grid(data, coder, field, grid);
  } else {
    copy(halves_of(file, "grid", numbers).data, numbers, grid);
  }
  for (int64_t i = 0; i < n; ++i) opacities[i] = opacities[i] < 0 ? 0 : opacities[i] > 1 ? 1 : opacities[i];
  for (int64_t i = 0; i < 3 * n; ++i) scales[i] = scales[i] < SMALLEST_SCALE ? SMALLEST_SCALE : scales[i];
}

}  // namespace swz
