// Gaussians that decoded anchors spawn for a place to look from, by the kernel that trains and draws them. Its floats are
// not part of the hash.
#include <sw_anchors/kernels/kernels.h>

#include "anchors.h"
#include "model.h"

#define EXPORT(name) extern "C" __attribute__((export_name(#name)))

namespace swz {

namespace {

constexpr int64_t AT_ONCE = 4608;  // anchors whose hidden layers are held: whole blocks of the kernel
constexpr splatwizard::Parallel ALONE;

// Of all Gaussians that are seen; as the host reads it.
struct Seen {
  float *means, *opacities, *scales, *quats, *colors;
};
Seen seen{};

const Array& array(const char* name) {
  for (int i = 0; i < decoded.count; ++i)
    if (std::strcmp(decoded.arrays[i].name, name) == 0) return decoded.arrays[i];
  refuse("nothing is decoded yet");
}

const float* values(const char* name) { return static_cast<const float*>(array(name).data); }

float* room(int64_t count) {
  Buffer<float> found(count);
  float* data = found.data;
  found.data = nullptr;  // it stays as long as the instance
  return data;
}

}  // namespace

// Evaluates the networks for an eye at x, y, z; how many Gaussians are not transparent then.
EXPORT(swz_see) int32_t swz_see(float x, float y, float z) {
  static Buffer<float> masks;
  static sw_anchors::Heads heads;
  const Array &features = array("features"), &offsets = array("offsets");
  const int64_t n = features.shape[0], k = offsets.shape[1], width = features.shape[1];
  if (masks.data == nullptr) {
    const auto* kept = static_cast<const uint32_t*>(array("masks").data);
    int64_t most = 0;
    masks = Buffer<float>(n * k);
    for (int64_t i = 0; i < n * k; ++i) masks[i] = static_cast<float>(kept[i]), most += kept[i];
    seen = {room(3 * most), room(most), room(3 * most), room(4 * most), room(3 * most)};
    const auto weights = [&](const char* network, const char* part) { return values(joined(network, part)); };
    heads.features = width, heads.hidden = array("mlp_color.0.bias").shape[0];
    for (int h = 0; h < sw_anchors::kHeads; ++h) {
      const char* name = DecodedAnchors::NETWORKS[h];
      heads.first[h] = weights(name, ".0.weight"), heads.first_bias[h] = weights(name, ".0.bias");
      heads.last[h] = weights(name, ".2.weight"), heads.last_bias[h] = weights(name, ".2.bias");
    }
  }
  const int64_t rows = AT_ONCE < n ? AT_ONCE : n;
  const float center[3] = {x, y, z};
  Buffer<float> hidden(arch_native::heads_rows(rows) * arch_native::heads_width(heads)), alpha(rows * k),
      opacities(rows * k), geometry(sw_anchors::kGeometry * rows * k), color(3 * rows * k);
  Buffer<int64_t> drawn(rows * k);
  int64_t found = 0;
  for (int64_t first = 0; first < n; first += rows) {
    sw_anchors::Anchors from{};
    from.n = n - first < rows ? n - first : rows, from.k = k;
    from.positions = values("anchors") + 3 * first;
    from.offsets = values("offsets") + 3 * k * first, from.offset_row = 3 * k;
    from.scales = values("scales") + 6 * first, from.scale_row = 6;
    from.masks = masks.data + k * first;
    arch_native::heads_opacities(from, {center, values("features") + width * first, width}, heads, hidden.data,
                                 alpha.data, opacities.data, ALONE);
    for (int64_t i = 0; i < from.n * k; ++i)
      if (opacities[i] > 0) drawn[from.count++] = i;
    from.alpha = alpha.data, from.drawn = drawn.data, from.compact = true;
    from.geometry = geometry.data, from.color = color.data;
    arch_native::heads_spawn(from, heads, hidden.data, geometry.data, color.data,
                             {seen.means + 3 * found, seen.opacities + found, seen.scales + 3 * found,
                              seen.quats + 4 * found, seen.colors + 3 * found}, ALONE);
    found += from.count;
  }
  return static_cast<int32_t>(found);
}

// Pointers to means, opacities, scales, quaternions and colours of those Gaussians.
EXPORT(swz_seen) const void* swz_seen() { return &seen; }

}  // namespace swz
