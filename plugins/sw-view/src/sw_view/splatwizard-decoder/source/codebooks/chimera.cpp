// The files of `chimerags`: two groups of Gaussians, without and with SH degree 3 (docs/bitstream.md).
#include "arrays.h"
#include "gaussian_files.h"
#include "model.h"
#include "points.h"
#include "vectors.h"

namespace swz {

namespace {

struct Group {
  const char *xyz, *box, *attributes;
  VectorParts vectors;
  int64_t others;  // coefficients of a colour above band 0
};

constexpr Group GROUPS[2] = {
    {"sh2/xyz", "sh2/box", "sh2/attributes",
     {{"sh2/vq/header", "sh2/vq/mask", "sh2/vq/indices", "sh2/vq/codebook", "sh2/vq/own"}, true}, 8},
    {"sh3/xyz", "sh3/box", "sh3/attributes",
     {{"sh3/vq/header", "sh3/vq/mask", "sh3/vq/indices", "sh3/vq/codebook", "sh3/vq/own"}, true}, 15}};

void put_means(Container& file, const Group& group, const Json& xyz, int64_t n, ArrayCoder planes, float* to) {
  double box[6] = {};
  if (xyz.is("uniform16")) {
    std::memcpy(box, file.array(group.box, FLOAT64, 2, 3).data, sizeof(box));
    const Blame blame(group.box);
    for (const double side : box)
      if (!__builtin_isfinite(side)) refuse("holds values that are not finite");
  }
  const Bytes data = file.section(group.xyz);
  const Blame blame(group.xyz);
  if (xyz.is("float32")) {
    float_delta(data, n, 3, to);
  } else if (xyz.is("float16")) {
    const Buffer<float> values = finite_halves(planes(data, n, 3, 2));
    std::memcpy(to, values.data, static_cast<size_t>(12 * n));
  } else {
    const Points points = octree(data);
    int64_t highest = 0;
    for (int64_t i = 0; i < points.codes.size; ++i)
      for (int axis = 0; axis < 3; ++axis) {
        const int64_t cell = points.coordinate(i, axis);
        highest = cell > highest ? cell : highest;
      }
    if (points.codes.size != n || highest > 65535)
      refuse(grouped(points.codes.size), " points of up to ", grouped(highest), ", expected ", grouped(n));
    for (int64_t i = 0; i < n; ++i)
      for (int axis = 0; axis < 3; ++axis) {
        const double share = static_cast<double>(points.coordinate(i, axis)) / 65535;
        to[3 * i + axis] = static_cast<float>(box[axis] + share * (box[3 + axis] - box[axis]));
      }
  }
  check_finite(to, 3 * n);
}

}  // namespace

void decode_chimera(Container& file) {
  const int64_t total = file.integer("num_gaussians", 0, UINT32_MAX), with_3 = file.integer("num_sh3", 0, total);
  file.integer("max_sh_degree", 3, 3);
  file.allow(236 * total, total);
  const Json *xyz = file.value("xyz"), *vq = file.value("vq"), *arrays = file.value("arrays");
  if (xyz == nullptr || !(xyz->is("float32") || xyz->is("float16") || xyz->is("uniform16")))
    refuse("header value 'xyz' must be one of float32, float16, uniform16");
  if (vq == nullptr || !vq->is("importance-vq")) refuse("the file asks for a coder of vectors that this decoder lacks");
  const ArrayCoder planes = array_coder(arrays == nullptr ? "byte-planes" : arrays->text);
  const Gaussians to(total, 3, 3);
  int64_t first = 0;
  for (const Group& group : GROUPS) {
    const int64_t n = first == 0 && &group == GROUPS ? total - with_3 : with_3;
    if (n == 0) continue;
    put_means(file, group, *xyz, n, planes, to.means + 3 * first);
    {
      const Bytes data = file.section(group.attributes);
      const Blame blame(group.attributes);
      put_attributes(to, first, n, finite_halves(planes(data, n, 8, 2)).data);
    }
    const Vectors vectors = importance_vq(file, group.vectors, n, 3 + 3 * group.others);
    for (int64_t i = 0; i < n; ++i) to.put_sh(first + i, vectors.row(i), group.others);
    first += n;
  }
}

}  // namespace swz
