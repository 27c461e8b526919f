// The CUDA kernels of surfels; sorting, pairs and colours are those of the other kernels (kernels.h). A splat's shape
// is an ellipse that holds every pixel the surfel may touch (surfel.h), its row of channels is the plane itself.
//
//   project_surfels           N surfels -> shapes and planes of the drawn ones
//   blend_surfels             pairs -> image and maps
//   blend_surfels_backward    gradients of both -> a row of sums for every surfel that was drawn
//   project_surfels_backward  rows of sums -> gradients of the inputs
#pragma once

#include "../surfel.h"
#include "kernels.h"

namespace sw::cuda {

struct SurfelImage {
  Image image;                  // three colours, no median
  float* maps;                  // [kMaps][H][W], or null
  SurfelPixels<float> pixels;   // null without maps, or if nothing is saved
};

// splats.channels: [kPlane] a splat. With `settings.tight` false the shape's centre is that of the published square.
void project_surfels(const View<float>& view, const Gaussians<float>& g, const Settings& settings, const Splats& splats,
                     const SplatWork& work, int32_t* radii, uint8_t* flags, Counters* counters, uint64_t* states,
                     Published* published, cudaStream_t stream);
void visible_surfel_radii(const View<float>& view, const Gaussians<float>& g, const Settings& settings, int32_t* radii,
                          cudaStream_t stream);
void blend_surfels(const View<float>& view, bool tight, const Splats& splats, const TileLists& lists,
                   const SurfelImage& image, Counters* counters, cudaStream_t stream);
// `maps`: [kMaps][H][W] or null; rows [N][surfel_columns], zeros before. `ordered`: pair_sums [pairs][surfel_columns].
void blend_surfels_backward(const View<float>& view, const Settings& settings, const Splats& splats,
                            const TileLists& lists, const SurfelImage& image, const ImageGradient& gradient,
                            const float* maps, float* rows, const Ordered& ordered, cudaStream_t stream);
void project_surfels_backward(const View<float>& view, const Gaussians<float>& g, const Settings& settings,
                              const uint8_t* flags, const float* rows, bool maps, const Gradients<float>& out,
                              cudaStream_t stream);

}  // namespace sw::cuda
