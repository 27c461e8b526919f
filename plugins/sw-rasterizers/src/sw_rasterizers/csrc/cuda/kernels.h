// The CUDA kernels: plain pointers, sizes and a stream; the memory is the caller's (face.h). float32 only.
//
//   project            N Gaussians -> splats of the drawn ones, compact and in index order; counts their tiles
//   shade              colours of the splats
//   depth_order        splats, nearest first (radix sort)
//   emit               one (tile, splat) pair for every tile that a splat touches, in depth order
//   sort_pairs         pairs by tile; stable, so front to back within a tile
//   find_tiles         where each tile's pairs start
//   blend              pairs -> image
//   blend_few          the same for three colours on small images; cuts the backward pass into pieces
//   blend_flash, blend_tcgs   the same, approximately and faster, three colours, no state for a backward pass
//   blend_backward     dL/dimage -> a row of sums for every Gaussian that was drawn
//   project_backward   rows of sums -> gradients of the inputs
#pragma once

#include <cuda_runtime_api.h>

#include <cstddef>
#include <cstdint>

#include "../call.h"
#include "../camera.h"

namespace sw::cuda {

// What the host must know before it can allocate; on the device while it is being counted. All zeros at the start.
struct Counters {
  unsigned long long pairs;
  unsigned splats, visible, invalid, project_ticket, project_done, emit_ticket;
  unsigned long long evaluated, blended;
};

// The same for the host, in pinned memory: written by the last block of `project`, but the colours that are not finite
// by whoever finds them.
struct Published {
  int64_t splats, pairs, visible, invalid;
  unsigned long long bad_colors;
};

// Splats as blended: log2 alpha = A dx^2 + B dx dy + C dy^2 + level, 40 bytes each.
struct Splats {
  float4* shape;  // [2 a splat]: u, v, A, B; C, level, red, green
  float2* tail;   // blue; index of the Gaussian, as bits
  float* channels;  // [channels] a splat instead of the three colours, or null
};

// What else is known of a splat until the pairs are emitted.
struct SplatWork {
  uint32_t* depth;   // bits of tz: positive, so they order like the number
  float2* extent;    // half width and half height of the cut-off ellipse, pixels
  int32_t* radius;   // classic profile: bounding radius
  int32_t* tiles;    // tiles touched
  int32_t* order;    // 0, 1, 2, ...
};

// drawn: bit 3 of a Gaussian's flags; bits 0 to 2: that colour was clamped at 0.
constexpr uint8_t kDrawn = 8;

constexpr int kMaxChunk = 8;  // channels that one launch of the general blend kernels composites

// Row of sums of a Gaussian: v, v dx, v dy, v dx^2, v dx dy, v dy^2 with v = dL/dsigma, then weight x gradient per
// channel, then with absgrad |dL/du|, |dL/dv|, then with median depth dL/dtz.
constexpr int kMomentSums = 6;
inline int row_length(int channels, bool absgrad, bool median) {
  return kMomentSums + channels + (absgrad ? 2 : 0) + (median ? 1 : 0);
}

struct Rows {
  float* base;     // row of Gaussian n at base + n * stride
  int64_t stride;
  int channels;
  bool absgrad, median;
  bool fragments = false;  // with absgrad, the two are the sum of (o dL/do)^2 over the fragments, and their number
};

// Where an image has fewer tiles than this, a block a tile leaves most of the GPU idle and the longest list decides how
// long it takes: the backward pass then takes a block for every kPiece pairs of a tile.
constexpr int kFewTiles = 3000, kPiece = 256;

// Pieces have a place each, empty ones included: those of a tile lie behind those of the tiles before it.
SW_HD int64_t first_piece(int tile, int start) { return int64_t(start) / kPiece + tile; }
inline int64_t piece_count(int64_t tiles, int64_t pairs) { return pairs / kPiece + tiles; }

// Below this many tiles the forward pass shares out the pieces, too (blend_few.cu); 0: a block a tile always.
constexpr int kSplitTiles = 1000;

struct Pieces {
  // [pieces][kTile^2] by warp and lane of `blend_few`: transmittance at a piece's end, colours behind it. Where
  // nothing is cut, memory of a forward pass that shares out pieces.
  float4* behind;
  int2* where;     // [pieces] tile and first list position, or -1 if no pixel got that far; null: not cut
  int64_t count;
};

struct Image {  // what the forward pass writes, and the backward pass reads again
  int channels, color_channels;
  float* image;             // [channels][H][W]
  const float* background;  // [colors] or [colors][H][W], or null
  bool background_is_image;
  float* alpha;          // [H][W], 1 - transmittance, or null
  float* transmittance;  // [H][W], or null
  int32_t* last;         // [H][W] 1-based list position of the last blended splat, or null
  float* median;         // [H][W] depth, or null
  int32_t* median_splat;  // [H][W] Gaussian of the median depth, -1 if none; or null
  Pieces pieces;
};

struct ImageGradient {
  const float* image;   // [channels][H][W]
  const float* alpha;   // [H][W] or null
  const float* median;  // [H][W] or null
};

// Items by what they belong to, in the order of their numbers: those of group k are item[start[k]] .. item[start[k+1]-1].
struct Groups {
  const int32_t* start;
  const int32_t* item;
};

// Where sums are to have one order: memory for the sums of each pair, and the pairs of each splat. All null: atomics.
struct Ordered {
  float* pair_sums;  // [pairs][pair_row_length]
  int64_t pairs, splats;
  Groups pairs_of_splat;
  Groups pixels_of_gaussian;  // by median depth, if that has a gradient
  int64_t gaussians;
};

struct TileLists {
  const int32_t* start;  // [tiles + 1]
  const int32_t* splat;  // [pairs]
};

constexpr int kProjectThreads = 128, kEmitThreads = 128;

void project(const View<float>& view, const Gaussians<float>& g, const Settings& settings, const Splats& splats,
             const SplatWork& work, int32_t* radii, uint8_t* flags, Counters* counters, uint64_t* states,
             Published* published, cudaStream_t stream);
void shade(const View<float>& view, const Gaussians<float>& g, const Settings& settings, const Splats& splats,
           int32_t* radii, uint8_t* flags, const Counters* counters, Published* published, cudaStream_t stream);
void fill_channels(const Gaussians<float>& g, const Channels& channels, const Splats& splats, const SplatWork& work,
                   int32_t* radii, uint8_t* flags, const Counters* counters, Published* published, cudaStream_t stream);
void visible_radii(const View<float>& view, const Gaussians<float>& g, const Settings& settings, int32_t* radii,
                   cudaStream_t stream);

// Sorts `order` by `depth`. The result lies in `order` or in `order_scratch`.
size_t depth_order_scratch(int count);
void depth_order(void* scratch, size_t bytes, int count, uint32_t* depth, uint32_t* depth_scratch, int32_t* order,
                 int32_t* order_scratch, int32_t** sorted, uint32_t** sorted_depth, cudaStream_t stream);
// Keys are uint16_t (`wide` false) or uint32_t. `compact` null: the values are splats as they are; else the splats are
// also copied into depth order and the values count there.
void emit(const View<float>& view, const Settings& settings, int count, const int32_t* order, const Splats& splats,
          const SplatWork& work, const Splats* compact, int channels, void* keys, bool wide, int32_t* values,
          Counters* counters, uint64_t* states, cudaStream_t stream);
size_t sort_pairs_scratch(int count, bool wide);
void sort_pairs(void* scratch, size_t bytes, int count, int key_bits, bool wide, void* keys, void* keys_scratch,
                int32_t* values, int32_t* values_scratch, void** sorted_keys, int32_t** sorted_values,
                cudaStream_t stream);
void find_tiles(int count, int tiles, const void* keys, bool wide, int32_t* start, cudaStream_t stream);
// to[i] = keys[i], or `none` where that is negative; numbers[i] = i.
void number_keys(int64_t count, const int32_t* keys, uint32_t none, uint32_t* to, int32_t* numbers,
                 cudaStream_t stream);

void blend(const View<float>& view, const Splats& splats, const TileLists& lists, const Image& image,
           bool general, Counters* counters, const uint32_t* depth, cudaStream_t stream);
// `scratch` null: a block a tile. Else pieces are shared out: image.pieces has `behind` and `count`, cut or not.
size_t few_scratch(int64_t tiles, int64_t pieces);
void blend_few(void* scratch, const View<float>& view, const Splats& splats, const TileLists& lists, const Image& image,
               cudaStream_t stream);
// Into image.image, or into `bytes` [3][H][W] as 8-bit levels if that is not null; and image.alpha.
void blend_flash(const View<float>& view, const Splats& splats, const TileLists& lists, const Image& image,
                 uint8_t* bytes, cudaStream_t stream);
void blend_tcgs(const View<float>& view, const Splats& splats, const TileLists& lists, const Image& image,
                uint8_t* bytes, cudaStream_t stream);
// The last `detached` channels do not influence the geometry; `pass_clamp`: the gradient passes the clamp of alpha.
void blend_backward(const View<float>& view, bool pass_clamp, const Splats& splats, const TileLists& lists,
                    const Image& image, bool general, const ImageGradient& gradient, int detached, const Rows& rows,
                    const Ordered& ordered, cudaStream_t stream);
int pair_row_length(bool general, bool absgrad);

// Adam of a [N, ...] tensor where its gradient is found, which is then never written. Formula and names: adam.cu of
// splatwizard-native. 16-byte aligned; all null: the gradient is written.
struct RowAdam {
  float *param, *exp_avg, *exp_avg_sq;
  float step_size, one_minus_beta1, beta2, one_minus_beta2, inv_bias2, eps;
};
struct ShAdam {
  RowAdam dc, rest;  // [N, 1, 3] and [N, 3, 8 or 15, 3]
  bool any() const { return dc.param != nullptr || rest.param != nullptr; }
};

void project_backward(const View<float>& view, const Gaussians<float>& g, const Settings& settings,
                      const Channels& channels, const uint8_t* flags, const Rows& rows, const Gradients<float>& out,
                      const ShAdam& adam, cudaStream_t stream);

}  // namespace sw::cuda
