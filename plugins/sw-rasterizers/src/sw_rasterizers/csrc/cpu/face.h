// The rasterizers on the CPU: what C and Python call. See <splatwizard/c_face.h> for the form.
//
//   plan_splats, project, draw               a picture
//   draw_backward                            gradients
//   add_scores, add_fisher                   sums over the pixels of each Gaussian
//   visible_radii
//   shade_shared, shade_shared_backward      colours from a codebook
//
// Gaussians are ellipsoids, or with kSurfels surfels. `flags` are those of ../flags.h. `camera`: R (9, row by row), tau (3),
// fx, fy, cx, cy, near, far. `splats` and `lists` are what one operation leaves for the next ones; they begin at a
// multiple of 64 bytes. Images are [channels, height, width]: colours, inverse depth, accumulated depth, features.
#pragma once
#include <splatwizard/c_face.h>

// How much memory `project` needs.
typedef struct {
  sw_head head;
  int32_t real_bytes;
  int64_t count;
  int64_t flags;
  int32_t channels;              // of the image
  int32_t color_channels;
  int32_t sh_degree;
  int64_t splat_bytes;           // out
} plan_splats_call;
SW_OPERATION(sw_rasterizers, plan_splats);

// Projects Gaussians. If more than `room` pairs of a splat and a tile were listed, it has to be called again with room
// for them.
typedef struct {
  sw_head head;
  int32_t real_bytes;
  const sw_real* means;          // [count, 3]
  const sw_real* opacities;      // [count]
  const sw_real* scales;         // [shapes, scale_columns] or null
  const sw_real* quats;          // [shapes, 4] or null
  const sw_real* cov3d;          // [count, 6] or null; in place of scales and quats
  const sw_real* sh;             // [count, sh_rows, 3] or null
  const sw_real* sh_dc;          // [count, 1, 3] or null
  const sw_real* sh_rest;        // [count, rest_rows, 3] or null
  const sw_real* colors;         // [count, color_channels] or null; in place of SH, which have 3
  const sw_real* features;       // [count, feature_channels] or null
  const sw_real* scale_factors;  // [count] or null
  const int64_t* geom_indices;   // [count] or null, rows of scales and quats, none outside
  const uint8_t* visible;        // [count] or null
  int64_t count, shapes, scale_columns, sh_rows, rest_rows, color_channels, feature_channels;
  double camera[18];
  int64_t width;
  int64_t height;
  int32_t sh_degree;
  double scale_modifier;
  double eps2d;
  int64_t flags;
  uint8_t* splats;               // [splat_bytes]
  int64_t splat_bytes;
  int32_t* tiles;                // [room]
  int64_t room;
  int32_t* radii;                // [count]
  int64_t seen;                  // out: Gaussians with a radius
  int64_t invalid;               // out: those culled because a value is not finite
  int64_t listed;                // out: pairs of all that had tiles
  int64_t used;                  // out: splats
  int64_t pairs;                 // out: their pairs
  int64_t list_bytes;            // out: what `draw` needs
  int64_t sum_bytes;             // out: what `draw_backward` needs
  double project_seconds;        // out
} project_call;
SW_OPERATION(sw_rasterizers, project);

// Lists the splats of each tile, front to back, and draws them.
typedef struct {
  sw_head head;
  int32_t real_bytes;
  uint8_t* splats;               // [splat_bytes]
  int64_t splat_bytes;
  const int32_t* tiles;          // [room]
  int64_t room;
  int64_t count;                 // of Gaussians
  int64_t used;                  // as `project` told
  int64_t pairs;
  double camera[18];
  int64_t width;
  int64_t height;
  int64_t channels, color_channels;
  int64_t flags;
  const sw_real* background;     // [color_channels] or null
  const sw_real* backdrop;       // [color_channels, height, width] or null, in place of it
  uint8_t* lists;                // [list_bytes]
  int64_t list_bytes;
  sw_real* image;                // [channels, height, width] or null: lists alone
  sw_real* alpha;                // [1, height, width] or null
  sw_real* median;               // [1, height, width] or null, depth
  sw_real* maps;                 // [7, height, width] or null, of surfels
  int64_t evaluated;             // out: pairs of a pixel and a splat; -1: they were not counted
  int64_t blended;               // out
  double sort_seconds;           // out
  double bin_seconds;            // out
  double blend_seconds;          // out
} draw_call;
SW_OPERATION(sw_rasterizers, draw);

// Gradients, of what there is a place for.
typedef struct {
  sw_head head;
  int32_t real_bytes;
  const sw_real* means;          // [count, 3]
  const sw_real* opacities;      // [count]
  const sw_real* scales;         // [shapes, scale_columns] or null
  const sw_real* quats;          // [shapes, 4] or null
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
  const sw_real* background;     // [color_channels] or null
  const sw_real* backdrop;       // [color_channels, height, width] or null
  uint8_t* splats;               // [splat_bytes]
  int64_t splat_bytes;
  uint8_t* lists;                // [list_bytes]
  int64_t list_bytes;
  int64_t pairs;
  const sw_real* by_image;       // [channels, height, width]
  const sw_real* by_alpha;       // [1, height, width] or null
  const sw_real* by_median;      // [1, height, width] or null
  const sw_real* by_maps;        // [7, height, width] or null
  int64_t channels;
  uint8_t* sums;                 // [sum_bytes] scratch
  int64_t sum_bytes;
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
  double blend_seconds;          // out
  double project_seconds;        // out
} draw_backward_call;
SW_OPERATION(sw_rasterizers, draw_backward);

// Radii from geometry alone, px; 0: culled.
typedef struct {
  sw_head head;
  int32_t real_bytes;
  const sw_real* means;          // [count, 3]
  const sw_real* scales;         // [shapes, scale_columns] or null
  const sw_real* quats;          // [shapes, 4] or null
  const sw_real* cov3d;          // [count, 6] or null
  const sw_real* scale_factors;  // [count] or null
  const int64_t* geom_indices;   // [count] or null
  const uint8_t* visible;        // [count] or null
  int64_t count, shapes, scale_columns;
  double camera[18];
  int64_t width;
  int64_t height;
  double scale_modifier;
  double eps2d;
  int64_t flags;
  int32_t* radii;                // [count]
} visible_radii_call;
SW_OPERATION(sw_rasterizers, visible_radii);

// Adds scores (../scores.h) of one view to totals: of kinds that depend on the light behind a splat, or of others.
typedef struct {
  sw_head head;
  int32_t real_bytes;
  uint8_t* splats;               // [splat_bytes]
  int64_t splat_bytes;
  uint8_t* lists;                // [list_bytes]
  int64_t list_bytes;
  int64_t count;
  int64_t pairs;
  double camera[18];
  int64_t width;
  int64_t height;
  int64_t channels, color_channels;
  int64_t flags;
  const sw_real* background;     // [color_channels] or null
  const sw_real* backdrop;       // [color_channels, height, width] or null
  int64_t scores;                // as many of each of the following
  int64_t kinds[32];
  int64_t tested[32];            // 1: rule "tested"
  double gammas[32];
  const sw_real* weights[32];    // of pixels [height, width], of a removal the residual [3, height, width], or null
  double* totals[32];            // [count]
  sw_real* sums;                 // [pairs, scores] scratch
} add_scores_call;
SW_OPERATION(sw_rasterizers, add_scores);

// Adds the Fisher blocks of one view.
typedef struct {
  sw_head head;
  int32_t real_bytes;
  const sw_real* means;          // [count, 3]
  const sw_real* scales;         // [count, 3]
  const sw_real* quats;          // [count, 4]
  int64_t count;
  uint8_t* splats;               // [splat_bytes]
  int64_t splat_bytes;
  uint8_t* lists;                // [list_bytes]
  int64_t list_bytes;
  int64_t pairs;
  double camera[18];
  int64_t width;
  int64_t height;
  int32_t sh_degree;
  double scale_modifier;
  double eps2d;
  int64_t channels, color_channels;
  int64_t flags;
  const sw_real* background;     // [color_channels] or null
  const sw_real* backdrop;       // [color_channels, height, width] or null
  double* blocks;                // [count, 21]
  sw_real* sums;                 // [pairs, 28] scratch
} add_fisher_call;
SW_OPERATION(sw_rasterizers, add_fisher);

// Colours of Gaussians as seen from `center`, from the rows of a codebook.
typedef struct {
  sw_head head;
  int32_t real_bytes;
  const sw_real* means;          // [count, 3]
  const sw_real* dc;             // [count, 1, 3] or null: it is in the codebook
  const sw_real* codebook;       // [entries, coefficients, 3]
  const int64_t* rows;           // [count], none outside
  const sw_real* center;         // [3]
  int64_t count, entries, coefficients;
  int32_t degree;
  int32_t clamp;                 // 1: negative colours become 0
  sw_real* colors;               // [count, 3]
} shade_shared_call;
SW_OPERATION(sw_rasterizers, shade_shared);

typedef struct {
  sw_head head;
  int32_t real_bytes;
  const sw_real* means;          // [count, 3]
  const sw_real* dc;             // [count, 1, 3] or null
  const sw_real* codebook;       // [entries, coefficients, 3]
  const int64_t* rows;           // [count]
  const sw_real* center;         // [3]
  int64_t count, entries, coefficients;
  int32_t degree;
  int32_t clamp;
  const int64_t* order;          // [count] positions by row
  const int64_t* offsets;        // [entries + 1] where those of a row begin in it
  const sw_real* by_colors;      // [count, 3]
  sw_real* passed;               // [count, 3] scratch
  float* carried;                // [runs, 48] or null: on a GPU scratch, a run for 128 Gaussians
  int64_t runs;
  sw_real* of_codebook;          // [entries, coefficients, 3]
  sw_real* of_means;             // [count, 3]
  sw_real* of_dc;                // [count, 1, 3] or null
} shade_shared_backward_call;
SW_OPERATION(sw_rasterizers, shade_shared_backward);
