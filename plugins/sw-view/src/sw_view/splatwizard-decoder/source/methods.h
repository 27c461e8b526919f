// Which files a module decodes: each has a decoder_of of its own.
#pragma once
#include "container.h"

namespace swz {

using Decoder = void (*)(Container& file);

// Goes on behind the packets that it has decoded, where a decoder set it: what a file with more of them adds.
extern Decoder go_on;

// Refuses what the module does not know.
Decoder decoder_of(const Container& file);

[[noreturn]] inline void lacks(const char* what, const Json* name) {
  refuse("this decoder does not know the ", what, " '", name != nullptr ? name->text : "", "'");
}

struct Codec {
  const char* name;
  Decoder decode;
};

// Methods whose result is a set of Gaussians that a codec wrote.
constexpr const char* BY_A_CODEC[] = {"3dgs", "pruned-3dgs", "trimming-the-fat", "pup-3dgs", "speedy-splat",
                                      "lightgaussian", "2dgs", "flat-3dgs", "trim-3dgs", "trim-2dgs",
                                      "trim-2dgs-scratch", "c3dgs", "mesongs", "gsc-quant"};

// The one of the codecs that the file of such a method names; refuses others.
template <int Count>
Decoder by_a_codec(const Container& file, const Codec (&codecs)[Count]) {
  bool is_known = false;
  for (const char* method : BY_A_CODEC) is_known |= file.method->is(method);
  if (!is_known) lacks("method", file.method);
  const Json* codec = file.value("codec");
  for (const Codec& each : codecs)
    if (codec != nullptr && codec->is(each.name)) return each.decode;
  lacks("codec", codec);
}

}  // namespace swz
