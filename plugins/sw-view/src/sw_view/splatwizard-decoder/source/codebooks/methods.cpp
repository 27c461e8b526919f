// The methods and codecs of codebooks.wasm: those that share colours or shapes, and those of other protocols.
#include "methods.h"

#include "gaussian_files.h"

namespace swz {

namespace {

constexpr Codec CODECS[] = {{"vectree", decode_vectree}, {"gaussians-indexed", decode_indexed}, {"raht", decode_raht},
                            {"gsc-quant", decode_gsc_quant}};

}  // namespace

Decoder decoder_of(const Container& file) {
  if (file.method->is("chimerags")) return decode_chimera;
  if (file.method->is("compact3dgs")) return decode_compact;
  return by_a_codec(file, CODECS);
}

}  // namespace swz
