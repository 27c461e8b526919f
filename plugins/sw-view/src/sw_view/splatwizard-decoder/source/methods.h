// Which files a module decodes: each has a decoder_of of its own.
#pragma once
#include "container.h"

namespace swz {

using Decoder = void (*)(Container& file);

// Refuses what the module does not know.
Decoder decoder_of(const Container& file);

[[noreturn]] inline void lacks(const char* what, const Json* name) {
  refuse("this decoder does not know the ", what, " '", name != nullptr ? name->text : "", "'");
}

}  // namespace swz
