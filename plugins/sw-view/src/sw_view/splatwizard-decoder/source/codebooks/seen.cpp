// Colours of decoded Gaussians for a place to look from, by their field. Its floats are not part of the hash.
#include "color_field.h"
#include "model.h"

#define EXPORT(name) extern "C" __attribute__((export_name(#name)))

namespace swz {

namespace {

using Four = float __attribute__((vector_size(16)));

// As the host reads it.
struct Seen {
  float *means, *opacities, *scales, *quats, *colors;
};
Seen seen{};

float* values(const char* name) {
  for (int i = 0; i < decoded.count; ++i)
    if (std::strcmp(decoded.arrays[i].name, name) == 0) return static_cast<float*>(decoded.arrays[i].data);
  refuse("nothing is decoded yet");
}

float* room(int64_t count) {
  Buffer<float> found(count);
  float* data = found.data;
  found.data = nullptr;  // it stays as long as the instance
  return data;
}

// A layer without biases whose outputs stand side by side for each input, a multiple of four of them.
struct Layer {
  Four* weights;  // [inputs, outputs / 4]
  int64_t inputs, outputs, fours;

  Layer(const float* from, int64_t in, int64_t out)
      : weights(reinterpret_cast<Four*>(room(in * ((out + 3) / 4 * 4)))), inputs(in), outputs(out), fours((out + 3) / 4) {
    auto* to = reinterpret_cast<float*>(weights);
    for (int64_t i = 0; i < in; ++i)
      for (int64_t o = 0; o < 4 * fours; ++o) to[i * 4 * fours + o] = o < out ? from[o * in + i] : 0;
  }
  void operator()(const float* x, Four* to, bool is_last) const {
    for (int64_t o = 0; o < fours; ++o) to[o] = Four{};
    for (int64_t i = 0; i < inputs; ++i) {
      if (x[i] == 0) continue;  // half of them, behind a ReLU
      const Four* row = weights + i * fours;
      for (int64_t o = 0; o < fours; ++o) to[o] += row[o] * x[i];
    }
    for (int64_t o = 0; o < fours && !is_last; ++o)
      for (int k = 0; k < 4; ++k) to[o][k] = to[o][k] > 0 ? to[o][k] : 0;
  }
};

// SH basis functions up to degree 2 of the direction from the eye.
void put_direction(const float* mean, const float* eye, float* to) {
  float d[3], length = 0;
  for (int axis = 0; axis < 3; ++axis) {
    d[axis] = mean[axis] - eye[axis];
    length += d[axis] * d[axis];
  }
  length = __builtin_sqrtf(length);
  for (float& each : d) each /= length > 1e-12f ? length : 1e-12f;
  const float x = d[0], y = d[1], z = d[2], C1 = 0.4886025119029199f, A = 1.0925484305920792f;
  const float basis[DIRECTION_VALUES] = {0.28209479177387814f, -C1 * y, C1 * z, -C1 * x, A * (x * y), -A * (y * z),
                                         0.31539156525252005f * (2 * z * z - x * x - y * y), -A * (x * z),
                                         0.5462742152960396f * (x * x - y * y)};
  std::memcpy(to, basis, sizeof(basis));
}

}  // namespace

// Evaluates the colours of all Gaussians for an eye at x, y, z; how many these are.
EXPORT(swz_see) int32_t swz_see(float x, float y, float z) {
  const ColorField& field = color_field;
  const float *means = values("means"), *grid = values("color.grid.table"), eye[3] = {x, y, z};
  const int64_t n = decoded.arrays[0].shape[0], width = field.width();
  static const Layer first(values("color.layers.0.weight"), field.inputs(), field.hidden);
  static const Layer second(values("color.layers.1.weight"), field.hidden, field.hidden);
  static const Layer last(values("color.layers.2.weight"), field.hidden, 3);
  static float* features = nullptr;  // no eye changes them
  if (features == nullptr) {
    features = room(n * width);
    for (int64_t i = 0; i < n; ++i) field.look_up(means + 3 * i, grid, features + width * i);
    seen = {values("means"), values("opacities"), values("scales"), values("quats"), room(3 * n)};
  }
  Buffer<float> inputs(field.inputs());
  Buffer<Four> hidden(first.fours), next(second.fours), out(last.fours);
  inputs[field.inputs() - 1] = 1;
  for (int64_t i = 0; i < n; ++i) {
    std::memcpy(inputs.data, features + width * i, sizeof(float) * static_cast<size_t>(width));
    put_direction(means + 3 * i, eye, inputs.data + width);
    first(inputs.data, hidden.data, false);
    second(reinterpret_cast<float*>(hidden.data), next.data, false);
    last(reinterpret_cast<float*>(next.data), out.data, true);
    for (int c = 0; c < 3; ++c) seen.colors[3 * i + c] = 0.5f + 0.28209479177387814f * out[0][c];
  }
  return static_cast<int32_t>(n);
}

// Pointers to means, opacities, scales, quaternions and colours of those Gaussians.
EXPORT(swz_seen) const void* swz_seen() { return &seen; }

}  // namespace swz
