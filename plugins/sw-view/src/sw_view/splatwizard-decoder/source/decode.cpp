// What the module exports. A host gets `swz_input(bytes)`, writes the file there, and calls `swz_decode`; if that traps,
// `swz_refusal` is the reason, or empty if the module itself failed. Then `swz_arrays` are read and copied, and the
// instance is thrown away: it decodes one file.
#include "gaussian_files.h"
#include "model.h"
#include "sha256.h"

#define EXPORT(name) extern "C" __attribute__((export_name(#name)))

namespace swz {

namespace {

Buffer<uint8_t> input;
char hash[65];

bool is_one_of(const Json& method, const char* const* names, int count) {
  for (int i = 0; i < count; ++i)
    if (method.is(names[i])) return true;
  return false;
}

// Methods whose result is a set of Gaussians that a codec wrote.
constexpr const char* BY_A_CODEC[] = {"pruned-3dgs", "trimming-the-fat", "pup-3dgs", "speedy-splat", "lightgaussian",
                                      "2dgs", "flat-3dgs", "trim-3dgs", "trim-2dgs", "trim-2dgs-scratch"};

[[noreturn]] void lacks(const char* what, const Json* name) {
  refuse("this decoder does not know the ", what, " '", name != nullptr ? name->text : "", "'");
}

void decode(Container& file) {
  const bool is_3dgs = file.method->is("3dgs");
  if (!is_3dgs && !is_one_of(*file.method, BY_A_CODEC, sizeof(BY_A_CODEC) / sizeof(*BY_A_CODEC)))
    lacks("method", file.method);
  if (file.version != 1) refuse("version ", file.version, " of the layout of '", file.method->text, "' is not known");
  const Json *codec = file.value("codec"), *mode = file.value("mode");
  if (codec == nullptr && is_3dgs && mode != nullptr && (mode->is("exact") || mode->is("quantized")))
    mode->is("exact") ? decode_exact(file) : decode_quantized(file);
  else if (codec == nullptr)
    lacks("mode", mode);
  else if (codec->is("gaussians-exact"))
    decode_exact(file);
  else if (codec->is("gaussians-quantized"))
    decode_quantized(file);
  else
    lacks("codec", codec);
  file.finish();
}

}  // namespace

EXPORT(swz_input) uint8_t* swz_input(int32_t bytes) {
  input = Buffer<uint8_t>(bytes);
  return input.data;
}

EXPORT(swz_decode) void swz_decode() {
  Container file(Bytes{input.data, input.size});
  decode(file);
}

EXPORT(swz_refusal) const char* swz_refusal() { return refusal.data; }

// Arrays of the model, `swz_count` of them: pointers to name and values, number of axes and four lengths, u32 each.
EXPORT(swz_arrays) const Array* swz_arrays() { return decoded.arrays; }
EXPORT(swz_count) int32_t swz_count() { return decoded.count; }

// The hash of the decoded model, 64 digits.
EXPORT(swz_hash) const char* swz_hash() {
  Sha256 sha;
  for (int i = 0; i < decoded.count; ++i) {
    int64_t size = 4;
    for (int axis = 0; axis < decoded.arrays[i].axes; ++axis) size *= decoded.arrays[i].shape[axis];
    sha.put(decoded.arrays[i].data, size);
  }
  sha.finish(hash);
  return hash;
}

}  // namespace swz
