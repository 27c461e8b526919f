// Float32 as trained: `gaussians-zstd` and `gaussians-ply` (docs/bitstream.md, Gaussians by a codec).
#include "arrays.h"
#include "gaussian_files.h"
#include "model.h"

namespace swz {

void decode_lossless(Container& file) {
  const int64_t n = file.integer("num_gaussians", 0, UINT32_MAX), degree = file.integer("max_sh_degree", 0, 3);
  file.integer("active_sh_degree", 0, degree);
  const int64_t scales = stated_scales(file);
  file.allow(4 * n * (8 + scales + 3 * (degree + 1) * (degree + 1)), n);
  file.usual("means", "float-delta");
  file.usual("arrays", "byte-planes");
  const Gaussians to(n, degree, scales);
  {
    const Bytes data = file.section("means");
    const Blame blame("means");
    float_delta(data, n, 3, to.means);
  }
  const auto planes = [&](const char* name, int64_t width, float* values) {
    const Bytes data = file.section(name);
    const Blame blame(name);
    const Buffer<uint8_t> plain = byte_planes(data, n, width, 4);
    std::memcpy(values, plain.data, static_cast<size_t>(plain.size));
  };
  planes("sh_dc", 3, to.sh_dc);
  planes("opacity_logits", 1, to.opacity_logits);
  planes("log_scales", scales, to.log_scales);
  planes("quats", 4, to.quats);
  planes("sh_rest", 3 * to.rest, to.sh_rest);
}

namespace {

// Takes a line of the header off the front; false if there stands another.
template <class... Parts>
bool skip(Bytes& data, Parts... parts) {
  Text line;
  (put(line, parts), ...);
  line.put("\n");
  if (data.left < line.size || std::memcmp(data.data, line.data, static_cast<size_t>(line.size)) != 0) return false;
  data.take(line.size);
  return true;
}

bool skip_header(Bytes& data, int64_t n, int64_t rest, int64_t scales) {
  bool fits = skip(data, "ply") && skip(data, "format binary_little_endian 1.0") && skip(data, "element vertex ", n);
  for (const char* name : {"x", "y", "z", "nx", "ny", "nz"}) fits = fits && skip(data, "property float ", name);
  const auto several = [&](const char* name, int64_t count) {
    for (int64_t i = 0; i < count; ++i) fits = fits && skip(data, "property float ", name, i);
  };
  several("f_dc_", 3);
  several("f_rest_", 3 * rest);
  fits = fits && skip(data, "property float opacity");
  several("scale_", scales);
  several("rot_", 4);
  return fits && skip(data, "end_header");
}

}  // namespace

void decode_ply(Container& file) {
  const int64_t n = file.integer("num_gaussians", 0, UINT32_MAX), degree = file.integer("max_sh_degree", 0, 3);
  const int64_t rest = (degree + 1) * (degree + 1) - 1, scales = stated_scales(file), row = 4 * (14 + scales + 3 * rest);
  Bytes data = file.section("ply");
  const Blame blame("ply");
  const int64_t size = data.left;
  if (!skip_header(data, n, rest, scales))
    refuse("is no .ply of ", grouped(n), " Gaussians with ", rest, " higher SH coefficients");
  if (data.left != n * row)
    refuse("is ", grouped(size), " bytes, ", grouped(n), " Gaussians take ", grouped(size - data.left + n * row));
  const Gaussians to(n, degree, scales);
  Buffer<float> values(row / 4);
  for (int64_t i = 0; i < n; ++i) {
    std::memcpy(values.data, data.take(row).data, static_cast<size_t>(row));
    const float *from = values.data, *shape = from + 9 + 3 * rest;
    std::memcpy(to.means + 3 * i, from, 12);
    to.put_sh(i, from + 6, rest);
    to.opacity_logits[i] = *shape;
    std::memcpy(to.log_scales + scales * i, shape + 1, static_cast<size_t>(4 * scales));
    std::memcpy(to.quats + 4 * i, shape + 1 + scales, 16);
  }
}

}  // namespace swz
