// Entropy model `categorical` (docs/bitstream.md), over any of the entropy coders.
#pragma once
#include "base.h"

namespace swz {

enum class Coder { RANGE, RANS, HUFFMAN, NONE };

// Which one a name stands for; NONE: another one.
Coder coder_of(const char* name);

// Which table codes a symbol: those of runs, one after the other, or each in turn.
struct TableOf {
  int64_t tables = 1;
  const int64_t* ends = nullptr;  // where the runs of the tables end; null: in turn

  // Calls with(symbol, table) for symbols first .. first + count - 1 in their order.
  template <class With>
  void each(int64_t first, int64_t count, const With& with) const {
    int64_t table = ends == nullptr ? first % tables : 0;
    for (int64_t i = first; i < first + count; ++i) {
      if (ends != nullptr)
        while (i >= ends[table]) ++table;
      with(i - first, table);
      if (ends == nullptr && ++table == tables) table = 0;
    }
  }
};

// Symbols [count] below `size`. Refuses damage.
void categorical(Bytes data, int64_t size, int64_t count, uint32_t* to, const TableOf& table_of = {},
                 Coder coder = Coder::RANGE);

}  // namespace swz
