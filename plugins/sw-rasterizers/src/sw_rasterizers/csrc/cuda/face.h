// The rasterizers on a GPU: what C and Python call. See <splatwizard/c_face.h> for the form, ../cpu/face.h for what
// Gaussians, flags and cameras are.
//
//   plan_render, render                      a picture
//   plan_sums, blend_backward, project_backward   gradients
//   accumulate_scores, accumulate_fisher     sums over the pixels of each Gaussian
//
// Numbers are float32. How many splats there are, and pairs of a splat and a tile, is known on the device alone: there
// is room for so many of each, guessed, and a call that finds more stops and tells how many. `render` is the only one
// that waits for the device.
#pragma once
#include "../cpu/face.h"

// How much memory `render` needs.
typedef struct {
  sw_head head;
  int64_t count;
  int64_t splat_room;            // splats
  int64_t room;                  // pairs
  int64_t width;
  int64_t height;
  int64_t channels;
  int64_t color_channels;
  int64_t flags;
  int64_t splat_bytes;           // out
  int64_t scratch_bytes;         // out
  int64_t list_bytes;            // out
} plan_render_call;
SW_OPERATION(sw_rasterizers_cuda, plan_render);

// Draws a view. If there is not enough room it has projected the Gaussians, no more, and is to be called again with room
// and `projected`, before any other call of this thread.
typedef struct {
  sw_head head;
  int32_t real_bytes;            // 4
  const sw_real* means;          // [count, 3]
  const sw_real* opacities;      // [count]
  const sw_real* scales;         // [shapes, scale_columns] or null
  const sw_real* quats;          // [shapes, 4] or null, at a multiple of 16 bytes
  const sw_real* cov3d;          // [count, 6] or null
  const sw_real* sh;             // [count, sh_rows, 3] or null
  const sw_real* sh_dc;          // [count, 1, 3] or null
  const sw_real* sh_rest;        // [count, rest_rows, 3] or null
  const sw_real* colors;         // [count, color_channels] or null
  const sw_real* features;       // [count, feature_channels] or null
  const sw_real* scale_factors;  // [count] or null
  const int64_t* geom_indices;   // [count] or null
  const uint8_t* visible;        // [count] or null
  int64_t count, shapes, scale_columns, sh_rows, rest_rows, color_channels, feature_channels;
  double camera[18];
  int64_t width;
  int64_t height;
  int32_t sh_degree;
  double scale_modifier;
  double eps2d;
  int64_t flags;
  int64_t channels;
  const sw_real* background;     // [color_channels] or null
  const sw_real* backdrop;       // [color_channels, height, width] or null, in place of it
  bool projected;                // an earlier call has left `splats`
  int64_t* mailbox;              // 128 bytes of pinned memory of the host, for this thread and GPU alone
  uint8_t* splats;               // [splat_bytes]
  int64_t splat_bytes;
  uint8_t* scratch;              // [scratch_bytes]
  int64_t scratch_bytes;
  uint8_t* lists;                // [list_bytes] what the backward pass and scores need, with kSave
  int64_t list_bytes;
  int32_t* first;                // [room] one of these two, by `kept_in`, belongs to `lists`
  int32_t* second;               // [room]
  int64_t room;
  int64_t splat_room;
  int32_t* radii;                // [count]
  uint8_t* drawn;                // [count] or null: for project_backward, with kSave
  float* image;                  // [channels, height, width] or null
  uint8_t* levels;               // [channels, height, width] or null: in place of it, with kBytes
  float* alpha;                  // [1, height, width] or null
  float* median;                 // [1, height, width] or null, depth
  float* maps;                   // [7, height, width] or null, of surfels
  bool complete;                 // out: there was room
  int32_t kept_in;               // out: 0: first, 1: second
  int64_t used;                  // out: splats
  int64_t pairs;                 // out
  int64_t seen;                  // out: Gaussians with a radius
  int64_t invalid;               // out: those culled because a value is not finite
  int64_t evaluated;             // out: pairs of a pixel and a splat; -1 without kCount
  int64_t blended;               // out
  double project_seconds;        // out: with kCount, which waits for the device; else 0
  double sort_seconds;           // out
  double bin_seconds;            // out
  double blend_seconds;          // out
} render_call;
SW_OPERATION(sw_rasterizers_cuda, render);

// Memory for sums over pairs.
typedef struct {
  sw_head head;
  int64_t channels;
  int64_t color_channels;
  int64_t flags;
  bool maps;                     // whether maps of surfels have a gradient
  int64_t used;
  int64_t pairs;
  int64_t pixels;                // with median depth
  int64_t count;                 // of Gaussians
  int64_t row_length;            // out: sums of a Gaussian that blend_backward makes
  int64_t blend_bytes;           // out: scratch of blend_backward; 0 without kOrdered, as the next two
  int64_t score_bytes;           // out: of accumulate_scores
  int64_t fisher_bytes;          // out: of accumulate_fisher
} plan_sums_call;
SW_OPERATION(sw_rasterizers_cuda, plan_sums);

// Sums of every Gaussian from the gradients of the picture; zeros where it was not drawn.
typedef struct {
  sw_head head;
  int32_t real_bytes;            // 4
  double camera[18];
  int64_t width;
  int64_t height;
  int64_t channels, color_channels;
  int64_t feature_channels;
  int64_t flags;
  const sw_real* background;     // [color_channels] or null
  const sw_real* backdrop;       // [color_channels, height, width] or null, in place of it
  uint8_t* lists;                // [list_bytes]
  int64_t list_bytes;
  const int32_t* pair_splats;    // [room] of `render`
  int64_t room;
  int64_t splat_room;            // as in `render`
  int64_t used;                  // as `render` told
  int64_t pairs;
  const sw_real* by_image;       // [channels, height, width]
  const sw_real* by_alpha;       // [1, height, width] or null
  const sw_real* by_median;      // [1, height, width] or null
  const sw_real* by_maps;        // [7, height, width] or null
  uint8_t* scratch;              // [scratch_bytes] or null: with kOrdered
  int64_t scratch_bytes;
  float* rows;                   // [count, row_length]
  int64_t count, row_length;
  double blend_seconds;          // out: with kCount
} blend_backward_call;
SW_OPERATION(sw_rasterizers_cuda, blend_backward);

// Gradients, of what there is a place for. Of shared shapes they are summed up: zeros before.
typedef struct {
  sw_head head;
  int32_t real_bytes;            // 4
  const sw_real* means;          // [count, 3]
  const sw_real* opacities;      // [count]
  const sw_real* scales;         // [shapes, scale_columns] or null
  const sw_real* quats;          // [shapes, 4] or null, at a multiple of 16 bytes
  const sw_real* cov3d;          // [count, 6] or null
  const sw_real* sh;             // [count, sh_rows, 3] or null
  const sw_real* sh_dc;          // [count, 1, 3] or null
  const sw_real* sh_rest;        // [count, rest_rows, 3] or null
  const sw_real* colors;         // [count, color_channels] or null
  const sw_real* features;       // [count, feature_channels] or null
  const sw_real* scale_factors;  // [count] or null
  const int64_t* geom_indices;   // [count] or null
  const uint8_t* visible;        // [count] or null
  int64_t count, shapes, scale_columns, sh_rows, rest_rows, color_channels, feature_channels;
  double camera[18];
  int64_t width;
  int64_t height;
  int32_t sh_degree;
  double scale_modifier;
  double eps2d;
  int64_t flags;
  const uint8_t* drawn;          // [count] of `render`
  const float* rows;             // [count, row_length]
  int64_t row_length;
  bool maps;                     // rows are those of maps
  sw_real* of_means;             // [count, 3] or null
  sw_real* of_opacities;         // [count] or null
  sw_real* of_scales;            // [shapes, scale_columns] or null
  sw_real* of_quats;             // [shapes, 4] or null
  sw_real* of_cov3d;             // [count, 6] or null
  sw_real* of_sh;                // [count, sh_rows, 3] or null
  sw_real* of_sh_dc;             // [count, 1, 3] or null
  sw_real* of_sh_rest;           // [count, rest_rows, 3] or null
  sw_real* of_colors;            // [count, color_channels] or null
  sw_real* of_features;          // [count, feature_channels] or null
  sw_real* of_scale_factors;     // [count] or null
  sw_real* of_grad2d;            // [count, 2] or null, NDC units
  sw_real* of_absgrad2d;         // [count, 2] or null
  float* dc_exp_avg;             // [count, 1, 3] or null: Adam does its step of sh_dc here, with
  float* dc_exp_avg_sq;          // [count, 1, 3] or null
  float* rest_exp_avg;           // [count, rest_rows, 3] or null: of sh_rest
  float* rest_exp_avg_sq;        // [count, rest_rows, 3] or null
  double dc_rates[6];            // lr / (1 - beta1^t), 1 - beta1, beta2, 1 - beta2, 1 / sqrt(1 - beta2^t), eps
  double rest_rates[6];
  double project_seconds;        // out: with kCount
} project_backward_call;
SW_OPERATION(sw_rasterizers_cuda, project_backward);

SW_OPERATION(sw_rasterizers_cuda, visible_radii);

// Adds scores (../scores.h) of one view to totals.
typedef struct {
  sw_head head;
  int32_t real_bytes;            // 4
  double camera[18];
  int64_t width;
  int64_t height;
  int64_t channels, color_channels;
  int64_t flags;
  const sw_real* background;     // [color_channels] or null
  const sw_real* backdrop;       // [color_channels, height, width] or null, in place of it
  uint8_t* lists;                // [list_bytes]
  int64_t list_bytes;
  const int32_t* pair_splats;    // [room] of `render`
  int64_t room;
  int64_t splat_room;            // as in `render`
  int64_t used;                  // as `render` told
  int64_t pairs;
  int64_t count;                 // of Gaussians
  int64_t scores;                // as many of each of the following
  int64_t kinds[32];
  int64_t tested[32];            // 1: rule "tested"
  double gammas[32];
  const float* weights[32];      // of pixels [height, width], of a removal the residual [3, height, width], or null
  double* totals[32];            // [count]
  uint8_t* scratch;              // [scratch_bytes] or null: with kOrdered
  int64_t scratch_bytes;
} accumulate_scores_call;
SW_OPERATION(sw_rasterizers_cuda, accumulate_scores);

// Adds the Fisher blocks of one view.
typedef struct {
  sw_head head;
  int32_t real_bytes;            // 4
  const sw_real* means;          // [count, 3]
  const sw_real* opacities;      // [count]
  const sw_real* scales;         // [shapes, scale_columns] or null
  const sw_real* quats;          // [shapes, 4] or null, at a multiple of 16 bytes
  const sw_real* cov3d;          // [count, 6] or null
  const sw_real* sh;             // [count, sh_rows, 3] or null
  const sw_real* sh_dc;          // [count, 1, 3] or null
  const sw_real* sh_rest;        // [count, rest_rows, 3] or null
  const sw_real* colors;         // [count, color_channels] or null
  const sw_real* features;       // [count, feature_channels] or null
  const sw_real* scale_factors;  // [count] or null
  const int64_t* geom_indices;   // [count] or null
  const uint8_t* visible;        // [count] or null
  int64_t count, shapes, scale_columns, sh_rows, rest_rows, color_channels, feature_channels;
  double camera[18];
  int64_t width;
  int64_t height;
  int32_t sh_degree;
  double scale_modifier;
  double eps2d;
  int64_t flags;
  int64_t channels;
  const sw_real* background;     // [color_channels] or null
  const sw_real* backdrop;       // [color_channels, height, width] or null, in place of it
  uint8_t* lists;                // [list_bytes]
  int64_t list_bytes;
  const int32_t* pair_splats;    // [room] of `render`
  int64_t room;
  int64_t splat_room;            // as in `render`
  int64_t used;                  // as `render` told
  int64_t pairs;
  const uint8_t* drawn;          // [count] of `render`
  float* rows;                   // [splats, 28] zeros, a row for each used one
  int64_t splats;
  double* blocks;                // [count, 21]
  uint8_t* scratch;              // [scratch_bytes] or null: with kOrdered
  int64_t scratch_bytes;
} accumulate_fisher_call;
SW_OPERATION(sw_rasterizers_cuda, accumulate_fisher);

SW_OPERATION(sw_rasterizers_cuda, shade_shared);
SW_OPERATION(sw_rasterizers_cuda, shade_shared_backward);
