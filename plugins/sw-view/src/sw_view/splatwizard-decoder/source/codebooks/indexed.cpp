// Codec `gaussians-indexed`: Gaussians that share colours and shapes (docs/bitstream.md).
#include "arrays.h"
#include "gaussian_files.h"
#include "model.h"

namespace swz {

namespace {

constexpr double MAX_LOG_FACTOR = 80;
constexpr int64_t MAX_ZERO = 1 << 20;

struct Lattices {
  float steps[6];
  int32_t zeros[6];
};

Lattices lattices_of(Container& file) {
  Lattices found;
  const Bytes steps = file.array("steps", FLOAT32, 6);
  const auto blame = [](const char* section, const char* reason) {
    const Blame by(section);
    refuse(reason);
  };
  std::memcpy(found.steps, steps.data, sizeof(found.steps));
  for (const float step : found.steps)
    if (!__builtin_isfinite(step)) blame("steps", "holds values that are not finite");
  for (const float step : found.steps)
    if (!(step > 0)) blame("steps", "not all are above 0");
  std::memcpy(found.zeros, file.array("zeros", INT32, 6).data, sizeof(found.zeros));
  for (const int32_t zero : found.zeros)
    if (zero < -MAX_ZERO || zero > MAX_ZERO) blame("zeros", "beyond +-2^20");
  return found;
}

}  // namespace

void decode_indexed(Container& file) {
  const int64_t n = file.integer("num_gaussians", 0, UINT32_MAX), least = n > 0;
  const int64_t colors = file.integer("num_colors", least, n), shapes = file.integer("num_shapes", least, n);
  const int64_t degree = file.integer("max_sh_degree", 0, 3), bands = (degree + 1) * (degree + 1);
  const Json* arrays = file.value("arrays");
  const ArrayCoder coder = array_coder(arrays == nullptr ? "" : arrays->text);
  file.allow(4 * (n * (20 + 3 * bands) + 3 * bands * colors + 7 * shapes), n);
  // In the order of the hash: means, then by name.
  float* means = decoded.add("means", n, 3);
  float* dc = decoded.add("color_dc", colors, 1, 3);
  float* rest = decoded.add("color_rest", colors, bands - 1, 3);
  float* factors = decoded.add("log_factors", n);
  float* opacities = decoded.add("opacity_values", n);
  float* quats = decoded.add("shape_quats", shapes, 4);
  float* scales = decoded.add("shape_scales", shapes, 3);
  {
    const Bytes data = file.section("xyz");
    const Blame blame("xyz");
    const Buffer<float> found = finite_halves(coder(data, n, 3, 2));
    std::memcpy(means, found.data, static_cast<size_t>(12 * n));
  }
  const Lattices lattices = lattices_of(file);
  struct Part {
    const char* section;
    float* to;
    int64_t rows, width;
  };
  const Part parts[6] = {{"opacity", opacities, n, 1}, {"factor", factors, n, 1},       {"dc", dc, colors, 3},
                         {"rest", rest, colors, 3 * (bands - 1)}, {"shape", scales, shapes, 3}, {"quat", quats, shapes, 4}};
  for (int part = 0; part < 6; ++part) {
    const auto& [section, to, rows, width] = parts[part];
    const Bytes data = file.section(section);
    const Blame blame(section);
    const Buffer<uint8_t> symbols = coder(data, rows, width, 1);
    for (int64_t i = 0; i < symbols.size; ++i)
      to[i] = static_cast<float>(symbols[i] - lattices.zeros[part]) * lattices.steps[part];
  }
  const auto index = [&](const char* name, int64_t size) {
    const Bytes data = file.section(name);
    const Blame blame(name);
    const int bytes = size <= 1 << 16 ? 2 : 4;
    const Buffer<uint8_t> found = coder(data, n, 1, bytes);
    uint32_t* to = decoded.add_index(name, n);
    for (int64_t i = 0; i < n; ++i) to[i] = static_cast<uint32_t>(Bytes{found.data + bytes * i, bytes}.integer(bytes));
    for (int64_t i = 0; i < n; ++i)
      if (to[i] >= size) refuse("an index is outside the codebook of ", grouped(size), " entries");
  };
  index("color_index", colors);
  index("shape_index", shapes);
  for (const auto& [section, values, rows, width] : parts) {
    const Blame blame(section);
    for (int64_t i = 0; i < rows * width; ++i) {
      if (!__builtin_isfinite(values[i])) refuse("holds values that are not finite in float32");
      if (values == factors && __builtin_fabs(values[i]) > MAX_LOG_FACTOR) refuse("a log factor is beyond +-80");
      if (values == scales && values[i] < 0) refuse("a shape has a negative scale");
      if (values == opacities) values[i] = values[i] < 0 ? 0 : values[i] > 1 ? 1 : values[i];
    }
  }
}

}  // namespace swz
