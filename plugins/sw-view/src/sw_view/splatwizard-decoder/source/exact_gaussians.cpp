// Float32 as trained: an array section for each parameter (docs/bitstream.md, 3dgs, exact).
#include "gaussian_files.h"
#include "model.h"

namespace swz {

int64_t stated_scales(const Container& file) {
  const Json* primitive = file.value("primitive");
  if (primitive == nullptr) return 3;
  if (!primitive->is("surfel")) refuse("header value 'primitive' must be one of surfel");
  return 2;
}

void decode_exact(Container& file) {
  const int64_t n = file.integer("num_gaussians", 0, UINT32_MAX), degree = file.integer("max_sh_degree", 0, 3);
  file.integer("active_sh_degree", 0, degree);
  const int64_t rest = (degree + 1) * (degree + 1) - 1, scales = stated_scales(file);
  const Bytes means = file.array("means", FLOAT32, n, 3), dc = file.array("sh_dc", FLOAT32, n, 1, 3),
              logits = file.array("opacity_logits", FLOAT32, n), log_scales = file.array("log_scales", FLOAT32, n, scales),
              quats = file.array("quats", FLOAT32, n, 4), higher = file.array("sh_rest", FLOAT32, n, rest, 3);
  const Gaussians to(n, degree, scales);
  const auto copy = [](float* values, Bytes from) { std::memcpy(values, from.data, static_cast<size_t>(from.left)); };
  copy(to.means, means);
  copy(to.sh_dc, dc);
  copy(to.opacity_logits, logits);
  copy(to.log_scales, log_scales);
  copy(to.quats, quats);
  copy(to.sh_rest, higher);
}

}  // namespace swz
