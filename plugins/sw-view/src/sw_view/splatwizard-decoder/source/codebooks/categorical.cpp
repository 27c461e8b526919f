#include "categorical.h"

#include <algorithm>

#include "chunks.h"

namespace swz {

namespace {

constexpr int64_t MOST_TABLES = 32;

// Words that are taken from the last one backwards, in place of those of the range coder.
struct RansSymbols {
  arch_native::WordReader words;

  explicit RansSymbols(Bytes payload) : words(payload.data, payload.left) {}
  int32_t symbol(const Model& model) {
    const auto q = static_cast<uint32_t>(words.state & arch_native::MASK);
    int32_t found = model.bucket[q >> (arch_native::BITS - 10)];
    while (model.share[found + 1] <= q) ++found;
    const uint64_t low = model.share[found];
    words.state = (words.state >> arch_native::BITS) * (model.share[found + 1] - low) + q - low;
    if (words.state < uint64_t{1} << 32 && words.left > 0)
      words.state = words.state << 32 | arch_native::word_at(words.words + 4 * --words.left);
    return found;
  }
};

struct RangeSymbols {
  arch_native::RangeReader words;

  explicit RangeSymbols(Bytes payload) : words(payload.data, payload.left) {}
  int32_t symbol(const Model& model) { return model.symbol(words); }
};

void check_words(Bytes payload) {
  if (payload.left % 4) refuse(grouped(payload.left), " coded bytes are not whole 32-bit words");
}

// A chunk, table by table in ascending number.
template <class From>
void take_by_table(Bytes payload, const Buffer<int64_t>& counts, int64_t size, const TableOf& table_of, int64_t first,
                   int64_t wanted, int32_t* symbols) {
  check_words(payload);
  From from(payload);
  bool used[MOST_TABLES] = {};
  table_of.each(first, wanted, [&](int64_t, int64_t table) { used[table] = true; });
  for (int64_t t = 0; t < table_of.tables; ++t) {
    if (!used[t]) continue;
    const Model model(counts.data + t * size, size);
    table_of.each(first, wanted, [&](int64_t i, int64_t table) {
      if (table == t) symbols[i] = model.only >= 0 ? static_cast<int32_t>(model.only) : from.symbol(model);
    });
  }
}

// The code of a table of counts: children of nodes size, size + 1, ..., the last of which is the root.
struct Tree {
  Buffer<int32_t> children;
  int32_t size;

  // Of the two smallest entries, by count, then by number, the first is the 0 child. Sums come in ascending order, so
  // those that wait are a queue.
  Tree(const int64_t* counts, int64_t entries) : children(2 * (entries - 1)), size(static_cast<int32_t>(entries)) {
    Buffer<int32_t> leaves(entries);
    Buffer<float> sums(entries - 1);
    for (int32_t i = 0; i < size; ++i) leaves[i] = i;
    const auto count = [&](int32_t leaf) { return static_cast<float>(counts[leaf]); };
    std::sort(leaves.data, leaves.data + size,
              [&](int32_t a, int32_t b) { return count(a) != count(b) ? count(a) < count(b) : a < b; });
    int32_t leaf = 0, waiting = 0;
    for (int32_t node = 0; node < size - 1; ++node) {
      sums[node] = 0;
      for (int child = 0; child < 2; ++child) {
        const bool is_leaf = leaf < size && (waiting == node || count(leaves[leaf]) <= sums[waiting]);
        children[2 * node + child] = is_leaf ? leaves[leaf] : size + waiting;
        sums[node] += is_leaf ? count(leaves[leaf]) : sums[waiting];
        is_leaf ? ++leaf : ++waiting;
      }
    }
  }
};

void take_codes(Bytes payload, const Buffer<int64_t>& counts, int64_t size, const TableOf& table_of, int64_t first,
                int64_t wanted, int32_t* symbols) {
  check_words(payload);
  Buffer<Tree> trees(table_of.tables);
  for (int64_t t = 0; t < table_of.tables; ++t) new (trees.data + t) Tree(counts.data + t * size, size);
  const int64_t end = 8 * payload.left;
  int64_t at = 0;
  table_of.each(first, wanted, [&](int64_t i, int64_t table) {
    const Tree& tree = trees[table];
    int32_t node = 2 * tree.size - 2;
    for (; node >= tree.size; ++at) {
      if (at >= end) refuse("the codes end before ", grouped(wanted), " symbols: truncated data or a wrong model");
      node = tree.children[2 * (node - tree.size) + (payload.data[at >> 3] >> (at & 7) & 1)];
    }
    symbols[i] = node;
  });
  for (int64_t t = 0; t < table_of.tables; ++t) trees[t].~Tree();
}

}  // namespace

Coder coder_of(const char* name) {
  static constexpr const char* NAMES[] = {"range", "rans", "huffman"};
  for (int i = 0; i < 3; ++i)
    if (std::strcmp(name, NAMES[i]) == 0) return static_cast<Coder>(i);
  return Coder::NONE;
}

void categorical(Bytes data, int64_t size, int64_t count, uint32_t* to, const TableOf& table_of, Coder coder) {
  const auto version = static_cast<int64_t>(data.integer(1));
  if (version != 1) refuse("categorical data of version ", version, " is not known: upgrade sw-codecs");
  if (count == 0) return data.finish();
  int64_t sizes[MOST_TABLES];
  for (int64_t t = 0; t < table_of.tables; ++t) sizes[t] = size;
  const Buffer<int64_t> counts = stored_tables(data, sizes, table_of.tables);
  bool any = false;
  for (int64_t t = 0; t < table_of.tables; ++t) {
    bool own = false;
    for (int64_t i = t * size; i < (t + 1) * size; ++i) own |= counts[i] > 0;
    for (int64_t i = t * size; i < (t + 1) * size && !own; ++i) counts[i] = 1;
    any |= own;
  }
  if (!any) refuse("the count tables are empty");
  auto* const found = reinterpret_cast<int32_t*>(to);
  const auto take = coder == Coder::RANGE  ? take_by_table<RangeSymbols>
                    : coder == Coder::RANS ? take_by_table<RansSymbols>
                                           : take_codes;
  read_chunks(data, count, size - 1, found, [&](Bytes payload, int32_t* symbols, int64_t wanted) {
    take(payload, counts, size, table_of, symbols - found, wanted, symbols);
  });
}

}  // namespace swz
