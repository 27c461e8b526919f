// The methods and codecs of decoder.wasm: those of explicit Gaussians, and wisp.
#include "methods.h"

#include "gaussian_files.h"

namespace swz {

namespace {

// Methods whose result is a set of Gaussians that a codec wrote.
constexpr const char* BY_A_CODEC[] = {"3dgs", "pruned-3dgs", "trimming-the-fat", "pup-3dgs", "speedy-splat",
                                      "lightgaussian", "2dgs", "flat-3dgs", "trim-3dgs", "trim-2dgs",
                                      "trim-2dgs-scratch", "c3dgs", "mesongs"};

struct Codec {
  const char* name;
  Decoder decode;
};
constexpr Codec CODECS[] = {{"gaussians-exact", decode_exact}, {"gaussians-quantized", decode_quantized},
                            {"gaussians-zstd", decode_lossless}, {"gaussians-ply", decode_ply},
                            {"vectree", decode_vectree}, {"gaussians-indexed", decode_indexed}, {"raht", decode_raht}};

}  // namespace

// Without a codec a file of 3dgs states its mode.
Decoder decoder_of(const Container& file) {
  if (file.method->is("chimerags")) return decode_chimera;
  if (file.method->is("wisp")) return decode_wisp;
  bool by_a_codec = false;
  for (const char* method : BY_A_CODEC) by_a_codec |= file.method->is(method);
  if (!by_a_codec) lacks("method", file.method);
  const Json *codec = file.value("codec"), *mode = file.value("mode");
  if (codec == nullptr && file.method->is("3dgs") && mode != nullptr) {
    if (mode->is("exact")) return decode_exact;
    if (mode->is("quantized")) return decode_quantized;
    lacks("mode", mode);
  }
  for (const Codec& each : CODECS)
    if (codec != nullptr && codec->is(each.name)) return each.decode;
  lacks("codec", codec);
}

}  // namespace swz
