// Large buffers that live for one iteration, kept for the next.
//
// A training step needs the same 100 MB of gradients and working space again and again. From malloc they come as fresh
// pages each time, and clearing those costs as much as the kernels that fill them (250k Gaussians: 14,000 page
// faults, 25 ms a step). Here a returned block is handed out again; the total kept never exceeds what was in use
// at once, the longest unused block going first.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <mutex>
#include <new>
#include <unordered_map>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace sw {

class Recycler {
 public:
  static constexpr size_t kPage = size_t(1) << 21;      // a huge page
  static constexpr size_t kSmallest = size_t(1) << 20;  // malloc keeps smaller ones itself

  // Never destroyed: tensors may outlive static destructors.
  static Recycler& instance() {
    static Recycler* const recycler = new Recycler;
    return *recycler;
  }

  void* take(size_t bytes) {
    const size_t size = (bytes + kPage - 1) / kPage * kPage;
    const std::lock_guard<std::mutex> lock(mutex_);
    auto best = idle_.end();
    for (auto block = idle_.begin(); block != idle_.end(); ++block)
      if (block->size >= size && block->size <= 2 * size && (best == idle_.end() || block->size < best->size))
        best = block;
    Block block{nullptr, size};
    if (best != idle_.end()) {
      block = *best;
      idle_.erase(best);
      idle_bytes_ -= block.size;
    } else {
      block.pointer = std::aligned_alloc(kPage, size);
      if (block.pointer == nullptr) throw std::bad_alloc();
#if defined(__linux__)
      madvise(block.pointer, size, MADV_HUGEPAGE);  // only a hint
#endif
    }
    used_[block.pointer] = block.size;
    used_bytes_ += block.size;
    most_used_ = std::max(most_used_, used_bytes_);
    return block.pointer;
  }

  void give(void* pointer) {
    const std::lock_guard<std::mutex> lock(mutex_);
    const auto found = used_.find(pointer);
    idle_.push_back({pointer, found->second});
    idle_bytes_ += found->second;
    used_bytes_ -= found->second;
    used_.erase(found);
    while (idle_bytes_ + used_bytes_ > most_used_) {
      idle_bytes_ -= idle_.front().size;
      std::free(idle_.front().pointer);
      idle_.erase(idle_.begin());
    }
  }

 private:
  struct Block {
    void* pointer;
    size_t size;
  };
  std::mutex mutex_;
  std::vector<Block> idle_;  // longest unused first
  std::unordered_map<void*, size_t> used_;
  size_t idle_bytes_ = 0, used_bytes_ = 0, most_used_ = 0;
};

}  // namespace sw
