#include "categorical.h"

#include "symbols.h"

namespace swz {

void categorical(Bytes data, int64_t size, int64_t count, uint32_t* to) {
  constexpr int64_t CHUNK = 1 << 20, HEADER = 20;
  const auto version = static_cast<int64_t>(data.integer(1));
  if (version != 1) refuse("categorical data of version ", version, " is not known: upgrade sw-codecs");
  if (count == 0) return data.finish();
  const Buffer<int64_t> counts = stored_tables(data, &size, 1);
  bool any = false;
  for (int64_t i = 0; i < size; ++i) any |= counts[i] > 0;
  if (!any) refuse("the count tables are empty");
  const Model model(counts.data, size);
  if (data.left < HEADER * ((count + CHUNK - 1) / CHUNK))
    refuse(grouped(data.left), " bytes cannot hold ", grouped(count), " symbols: truncated data or a wrong number");
  for (int64_t start = 0; start < count; start += CHUNK) {
    const int64_t wanted = count - start < CHUNK ? count - start : CHUNK;
    const auto number = static_cast<int64_t>(data.integer(4));
    const auto low = static_cast<int32_t>(data.integer(4)), high = static_cast<int32_t>(data.integer(4));
    const auto length = static_cast<int64_t>(data.integer(4));
    const uint64_t crc = data.integer(4);
    if (number != wanted) refuse("a chunk has ", grouped(number), " symbols, expected ", grouped(wanted));
    if (low < 0 || high < low || high >= size)
      refuse("a chunk has symbols ", low, "..", high, ", the model's domain is 0..", size - 1);
    const Bytes payload = data.take(length);
    auto* symbols = reinterpret_cast<int32_t*>(to + start);
    int32_t least = high, most = low;
    if (low == high) {
      if (length) refuse("a chunk of one repeated symbol has a payload");
      for (int64_t i = 0; i < wanted; ++i) symbols[i] = low;
    } else {
      Symbols(payload).take(model, symbols, wanted);
      for (int64_t i = 0; i < wanted; ++i) {
        least = symbols[i] < least ? symbols[i] : least;
        most = symbols[i] > most ? symbols[i] : most;
      }
      if (least != low || most != high) refuse(CRC_DIFFERS);
    }
    if (crc32(symbols, 4 * wanted) != crc) refuse(CRC_DIFFERS);
  }
  data.finish();
}

}  // namespace swz
