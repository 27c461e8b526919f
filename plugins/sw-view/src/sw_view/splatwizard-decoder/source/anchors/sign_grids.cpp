#include "sign_grids.h"

namespace swz {

namespace {

constexpr int AXES[4][3] = {{0, 1, 2}, {0, 1, 0}, {0, 2, 0}, {1, 2, 0}};
constexpr splatwizard::Parallel ALONE;

int64_t power(int64_t base, int exponent) {
  int64_t found = 1;
  for (int i = 0; i < exponent; ++i) found *= base;
  return found;
}

}  // namespace

// Where the entries and outputs of each level are.
void SignGrids::lay_out(Grid& grid, const IntegerList& resolutions, int64_t log2) {
  int64_t size[MOST_LEVELS], start[MOST_LEVELS];
  bool dense[MOST_LEVELS];
  for (int64_t l = 0; l < resolutions.count; ++l) {
    const int64_t vertices = power(resolutions[l], grid.dimensions), most = int64_t{1} << log2;
    size[l] = ((vertices < most ? vertices : most) + 7) / 8 * 8;
    dense[l] = vertices <= size[l];
    start[l] = grid.entries;
    grid.entries += size[l];
    grid.dense += dense[l];
  }
  for (const bool are_dense : {true, false})
    for (int64_t l = 0; l < resolutions.count; ++l) {
      if (dense[l] != are_dense) continue;
      grid.last[grid.levels] = resolutions[l] - 1;
      grid.start[grid.levels] = start[l];
      grid.column[grid.levels++] = width + l * features_of_entry;
    }
  width += resolutions.count * features_of_entry;
}

SignGrids::SignGrids(Container& file) {
  features_of_entry = file.integer("grid_features", 1, 16);
  const IntegerList space(file, "grid_space", 3, 4096, MOST_LEVELS), planes(file, "grid_planes", 3, 4096, MOST_LEVELS);
  const IntegerList log2(file, "grid_log2", 3, 22, 2, 2);
  int64_t entries = 0;
  for (int i = 0; i < 4; ++i) {
    log2_size[i > 0] = log2[i > 0];
    grids[i].dimensions = i ? 2 : 3;
    for (int axis = 0; axis < 3; ++axis) grids[i].axes[axis] = AXES[i][axis];
    lay_out(grids[i], i ? planes : space, log2[i > 0]);
    entries += grids[i].entries;
  }
  const int64_t count = entries * features_of_entry;
  file.allow_what(4 * count, "a hash grid of ", grouped(count), " signs");
  const Bytes data = file.section("grids");
  const Blame blame("grids");
  Buffer<int32_t> bits(count);
  bernoulli(data, count, bits.data);
  const int32_t* next = bits.data;
  for (Grid& grid : grids) {
    grid.signs = Buffer<uint16_t>(grid.entries);
    for (int64_t entry = 0; entry < grid.entries; ++entry) {
      uint32_t signs = 0;
      for (int64_t f = 0; f < features_of_entry; ++f) signs |= static_cast<uint32_t>(*next++) << f;
      grid.signs[entry] = static_cast<uint16_t>(signs);
    }
  }
}

void SignGrids::features(const int64_t* codes, int64_t rows, int16_t* to) const {
  for (const Grid& grid : grids) {
    const bool is_plane = grid.dimensions == 2;
    arch_native::grid_features({codes, {grid.axes[0], grid.axes[1], grid.axes[2]}, grid.dimensions, grid.signs.data,
                                static_cast<int>(features_of_entry), grid.last, grid.start, grid.column, grid.levels,
                                grid.dense, log2_size[is_plane], rows, nullptr, to, width}, ALONE);
  }
}

}  // namespace swz
