#include "model.h"

namespace swz {

Model3D decoded;
void (*hash_of_integers)(Sha256& sha) = nullptr;

int64_t Array::size() const {
  int64_t found = 1;
  for (int axis = 0; axis < axes; ++axis) found *= shape[axis];
  return found;
}

void Model3D::clear() {
  while (count > 0) {
    const Array& last = arrays[--count];
    Buffer<float> values;
    values.data = static_cast<float*>(last.data), values.size = last.size();
  }
}

float* Model3D::add(const char* name, int64_t first, int64_t second, int64_t third) {
  Array& array = arrays[count++];
  array = {name, nullptr, 0, 0, {}};
  int64_t size = 1;
  for (const int64_t length : {first, second, third}) {
    if (length < 0) break;
    array.shape[array.axes++] = static_cast<uint32_t>(length);
    size *= length;
  }
  Buffer<float> values(size);
  values.clear();
  array.data = values.data;
  values.data = nullptr;  // it stays as long as the instance
  return static_cast<float*>(array.data);
}

uint32_t* Model3D::add_index(const char* name, int64_t length) {
  auto* values = reinterpret_cast<uint32_t*>(add(name, length));
  arrays[count - 1].is_index = 1;
  return values;
}

void Model3D::check_finite() const {
  for (int i = 0; i < count; ++i) {
    if (arrays[i].is_index) continue;
    const auto* data = static_cast<const float*>(arrays[i].data);
    const int64_t size = arrays[i].size();
    for (int64_t k = 0; k < size; ++k)
      if (!__builtin_isfinite(data[k]))
        refuse("decoded '", arrays[i].name, "' is not finite: the file is damaged or hostile");
  }
}

Gaussians::Gaussians(int64_t gaussians, int64_t sh_degree, int64_t scales)
    : count(gaussians), rest((sh_degree + 1) * (sh_degree + 1) - 1) {
  means = decoded.add("means", count, 3);
  log_scales = decoded.add("log_scales", count, scales);
  quats = decoded.add("quats", count, 4);
  opacity_logits = decoded.add("opacity_logits", count);
  sh_dc = decoded.add("sh_dc", count, 1, 3);
  sh_rest = decoded.add("sh_rest", count, rest, 3);
}

}  // namespace swz
