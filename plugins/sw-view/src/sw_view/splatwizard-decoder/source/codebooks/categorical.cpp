#include "categorical.h"

#include "chunks.h"

namespace swz {

void categorical(Bytes data, int64_t size, int64_t count, uint32_t* to) {
  const auto version = static_cast<int64_t>(data.integer(1));
  if (version != 1) refuse("categorical data of version ", version, " is not known: upgrade sw-codecs");
  if (count == 0) return data.finish();
  const Buffer<int64_t> counts = stored_tables(data, &size, 1);
  bool any = false;
  for (int64_t i = 0; i < size; ++i) any |= counts[i] > 0;
  if (!any) refuse("the count tables are empty");
  const Model model(counts.data, size);
  read_chunks(data, count, size - 1, reinterpret_cast<int32_t*>(to),
              [&](Bytes payload, int32_t* symbols, int64_t wanted) { Symbols(payload).take(model, symbols, wanted); });
}

}  // namespace swz
