// Codec `vectree`: positions without loss, colours by `importance-vq`, the rest in float16 (docs/bitstream.md).
#include "arrays.h"
#include "gaussian_files.h"
#include "model.h"
#include "vectors.h"

namespace swz {

void put_attributes(const Gaussians& to, int64_t first, int64_t count, const float* attributes) {
  for (int64_t i = 0; i < count; ++i, attributes += 8) {
    to.opacity_logits[first + i] = attributes[0];
    std::memcpy(to.log_scales + 3 * (first + i), attributes + 1, 12);
    std::memcpy(to.quats + 4 * (first + i), attributes + 4, 16);
  }
}

void decode_vectree(Container& file) {
  const int64_t n = file.integer("num_gaussians", 0, UINT32_MAX), degree = file.integer("max_sh_degree", 0, 3);
  file.integer("active_sh_degree", 0, degree);
  const int64_t bands = (degree + 1) * (degree + 1);
  file.allow(4 * n * (11 + 3 * bands), n);
  const Json* arrays = file.value("arrays");
  const ArrayCoder planes = array_coder(arrays == nullptr ? "byte-planes" : arrays->text);
  const Gaussians to(n, degree, 3);
  {
    const Bytes data = file.section("xyz");
    const Blame blame("xyz");
    float_delta(data, n, 3, to.means);
    check_finite(to.means, 3 * n);
  }
  {
    const Bytes data = file.section("attr");
    const Blame blame("attr");
    put_attributes(to, 0, n, finite_halves(planes(data, n, 8, 2)).data);
  }
  const Vectors colors = importance_vq(file, {{"vq", "mask", "index", "codebook", "sh_keep"}, false}, n, 3 * bands);
  for (int64_t i = 0; i < n; ++i) to.put_sh(i, colors.row(i), bands - 1);
}

}  // namespace swz
