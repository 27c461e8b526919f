// Huffman decoding: the first bits of a code are looked up in a table of its tree, longer codes go on bit by bit.
#include <algorithm>
#include <cstring>
#include <queue>
#include <utility>
#include <vector>

#include "kernels.h"

namespace SW_ARCH {
namespace {

constexpr int kMostBits = 11;
constexpr int64_t kMostEntries = int64_t(1) << 20;  // of all tables together: 8 MB

struct Step {
  int32_t node;  // a symbol, or an inner node to go on from
  int32_t bits;  // taken
};

// Children of the inner nodes size, size + 1, ...; the last one is the root. Smallest counts, then numbers, join first.
void build(const float* counts, int64_t size, int32_t (*children)[2]) {
  using Entry = std::pair<float, int32_t>;
  std::priority_queue<Entry, std::vector<Entry>, std::greater<Entry>> queue;
  for (int64_t symbol = 0; symbol < size; ++symbol) queue.emplace(counts[symbol], int32_t(symbol));
  const auto take = [&] {
    const Entry smallest = queue.top();
    queue.pop();
    return smallest;
  };
  for (int64_t node = 0; node < size - 1; ++node) {
    const Entry first = take(), second = take();
    children[node][0] = first.second, children[node][1] = second.second;
    queue.emplace(first.first + second.first, int32_t(size + node));
  }
}

void fill(const int32_t (*children)[2], int32_t size, int bits, Step* table) {
  for (int32_t code = 0; code < 1 << bits; ++code) {
    Step step{2 * size - 2, 0};
    while (step.node >= size && step.bits < bits) step.node = children[step.node - size][code >> step.bits++ & 1];
    table[code] = step;
  }
}

}  // namespace

bool huffman_decode(const uint8_t* bytes, int64_t length, const float* counts, int64_t trees, int64_t size,
                    const int64_t* index, int64_t n, int32_t* symbols) {
  const int64_t inner = size - 1;
  std::vector<int32_t> children(size_t(2 * trees * inner));
  const auto nodes = [&](int64_t tree) { return reinterpret_cast<int32_t(*)[2]>(children.data()) + tree * inner; };
  int bits = kMostBits;  // no more than the tables may take together; 0: bit by bit from the root
  while (bits > 0 && trees << bits > kMostEntries) --bits;
  std::vector<Step> steps(size_t(trees) << bits);
  for (int64_t tree = 0; tree < trees; ++tree) {
    build(counts + tree * size, size, nodes(tree));
    fill(nodes(tree), int32_t(size), bits, steps.data() + (tree << bits));
  }
  const int64_t end = 8 * length;
  const uint32_t mask = (1u << bits) - 1;
  int64_t at = 0;  // bits read
  for (int64_t i = 0; i < n; ++i) {
    const int64_t tree = index[i], byte = at >> 3;
    uint32_t window = 0;
    std::memcpy(&window, bytes + std::min(byte, length), size_t(std::min<int64_t>(4, std::max<int64_t>(length - byte, 0))));
    Step step = steps[size_t(tree << bits) + (window >> (at & 7) & mask)];
    at += step.bits;
    while (step.node >= size) {
      if (at >= end) return false;
      step.node = nodes(tree)[step.node - size][bytes[at >> 3] >> (at & 7) & 1];
      ++at;
    }
    if (at > end) return false;
    symbols[i] = step.node;
  }
  return true;
}

}  // namespace SW_ARCH
