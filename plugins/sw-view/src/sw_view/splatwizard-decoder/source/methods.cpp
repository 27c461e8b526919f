// The methods and codecs of decoder.wasm: those of explicit Gaussians, and wisp.
#include "methods.h"

#include "gaussian_files.h"

namespace swz {

namespace {

constexpr Codec CODECS[] = {{"gaussians-exact", decode_exact}, {"gaussians-quantized", decode_quantized},
                            {"gaussians-tiles", decode_tiles}, {"gaussians-zstd", decode_lossless},
                            {"gaussians-ply", decode_ply}};

}  // namespace

// Without a codec a file of 3dgs states its mode.
Decoder decoder_of(const Container& file) {
  if (file.method->is("wisp")) return decode_wisp;
  const Json* mode = file.value("mode");
  if (file.value("codec") == nullptr && file.method->is("3dgs") && mode != nullptr) {
    if (mode->is("exact")) return decode_exact;
    if (mode->is("quantized")) return decode_quantized;
    lacks("mode", mode);
  }
  return by_a_codec(file, CODECS);
}

}  // namespace swz
