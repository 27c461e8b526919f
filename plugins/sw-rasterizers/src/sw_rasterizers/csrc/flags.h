// How a call is to be drawn, in one number.
#pragma once

#include <cstdint>

namespace sw {

enum Flag : int64_t {  // mirrored in ops.py
  kAntialias = 1,
  kClampColor = 2,
  kTight = 4,
  kPassClamp = 8,
  kInverseDepth = 16,
  kAccumulatedDepth = 32,
  kMedianDepth = 64,
  kDetachFeatures = 128,
  kAbsgrad = 256,
  kAlphaMap = 512,
  kSave = 1024,
  kCount = 2048,
  kOriginalJacobian = 4096,
  kFlash = 8192,  // CUDA only
  kTensorCores = 16384,
  kBytes = 32768,
  kForScores = 65536,  // with kSave: nothing that only the backward pass needs
  kOrdered = 131072,   // CUDA: sums of the backward pass in one order; on the CPU they always are
  kFragments = 262144,
  kSurfels = 1 << 19,  // scales [N,2]
  kWithMaps = 1 << 20,  // of surfels: depth, normals, distortion
};

}  // namespace sw
