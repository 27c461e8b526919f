// The methods of anchors.wasm.
#include "methods.h"

#include "methods_of_anchors.h"

namespace swz {

Decoder decoder_of(const Container& file) {
  if (file.method->is("hac")) return decode_hac;
  if (file.method->is("hac-plus")) return decode_hac_plus;
  if (file.method->is("cat-3dgs")) return decode_cat;
  lacks("method", file.method);
}

}  // namespace swz
