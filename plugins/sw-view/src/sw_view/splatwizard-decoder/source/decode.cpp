// What the module exports. A host gets `swz_input(bytes)`, writes the file there, for some methods `swz_tables(bytes)`
// with what exact_tables.h says, and calls `swz_decode`; if that traps,
// `swz_refusal` is the reason, or empty if the module itself failed. Then `swz_arrays` are read and copied, and the
// instance is thrown away: it decodes one file, all at once or, by `swz_go_on`, in packets.
#include "exact_tables.h"
#include "methods.h"
#include "model.h"
#include "sha256.h"

#define EXPORT(name) extern "C" __attribute__((export_name(#name)))

namespace swz {

namespace {

Buffer<uint8_t> input;
char hash[65];

void decode(Container& file) {
  const Decoder decoder = decoder_of(file);
  if (file.version != 1) refuse("version ", file.version, " of the layout of '", file.method->text, "' is not known");
  decoder(file);
  file.finish();
}

}  // namespace

Decoder go_on = nullptr;

EXPORT(swz_input) uint8_t* swz_input(int32_t bytes) {
  input = Buffer<uint8_t>(bytes);
  return input.data;
}

// Where the host puts the exact tables, a zlib stream of so many bytes, if the file needs them.
EXPORT(swz_tables) uint8_t* swz_tables(int32_t bytes) {
  packed_tables = Buffer<uint8_t>(bytes);
  return packed_tables.data;
}

// Decodes the first `packets` packets of a file with cuts; 0: all that are there.
EXPORT(swz_decode) void swz_decode(int32_t packets) {
  Container file(Bytes{input.data, input.size}, packets);
  decode(file);
}

// Goes on to the first `packets` of the same file, 0: to all, without what is decoded already. Returns 1, or 0 where
// the method of the file begins anew instead, in another instance. Arrays that were read before are gone.
EXPORT(swz_go_on) int32_t swz_go_on(int32_t packets) {
  if (go_on == nullptr) return 0;
  Container file(Bytes{input.data, input.size}, packets);
  go_on(file);
  file.finish();
  return 1;
}

EXPORT(swz_refusal) const char* swz_refusal() { return refusal.data; }

// Arrays of the model, `swz_count` of them: pointers to name and values, whether it is an index, number of axes
// and four lengths, u32 each.
EXPORT(swz_arrays) const Array* swz_arrays() { return decoded.arrays; }
EXPORT(swz_count) int32_t swz_count() { return decoded.count; }

// The hash of the decoded model, 64 digits.
EXPORT(swz_hash) const char* swz_hash() {
  Sha256 sha;
  if (hash_of_integers != nullptr) hash_of_integers(sha);
  for (int i = 0; i < decoded.count && hash_of_integers == nullptr; ++i) {
    if (decoded.arrays[i].is_index) continue;
    sha.put(decoded.arrays[i].data, 4 * decoded.arrays[i].size());
  }
  sha.finish(hash);
  return hash;
}

}  // namespace swz
