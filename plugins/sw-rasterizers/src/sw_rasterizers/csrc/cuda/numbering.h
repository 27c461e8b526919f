// Numbers for what a projection draws: in index order, within the launch, from a prefix sum over the grid.
//
// Equal depths are later drawn in the order of these numbers, so they may not depend on timing.
#pragma once

#include "device.h"
#include "kernels.h"

namespace sw::cuda {

struct Numbering {  // of a block, in shared memory
  unsigned scratch[kWarp + 1];
  unsigned block, tiles, drawn;
  alignas(16) unsigned base;  // no neighbour's wide load may touch it while it is written
};

struct Outcome {  // of one thread's Gaussian
  bool visible, drawn, invalid;
  unsigned tiles;
};

__device__ __forceinline__ void start_numbering(Numbering& block, Counters* counters) {
  if (threadIdx.x == 0) block.block = atomicAdd(&counters->project_ticket, 1u), block.tiles = 0;
  __syncthreads();
}

// The number of what this thread drew; adds to the counters.
__device__ __forceinline__ unsigned take_number(Numbering& block, Counters* counters, uint64_t* states,
                                                const Outcome& own) {
  // Sums of the block first: atomics on one address pass one after the other.
  const unsigned warp_tiles = warp_sum(own.tiles);  // a block's fit 32 bits: below 2^24 tiles a splat
  if (lane_index() == 0) atomicAdd(&block.tiles, warp_tiles);
  const unsigned visible = unsigned(__syncthreads_count(own.visible));
  unsigned block_drawn;
  const unsigned position = block_prefix(own.drawn, block.scratch, &block_drawn);
  const unsigned bad = warp_sum(own.invalid);
  if (lane_index() == 0 && bad > 0) atomicAdd(&counters->invalid, bad);
  if (threadIdx.x == 0) block.drawn = block_drawn;
  if (threadIdx.x == 0 && visible > 0) {
    atomicAdd(&counters->visible, visible);
    atomicAdd(&counters->pairs, static_cast<unsigned long long>(block.tiles));
  }
  if (warp_index() == 0) {
    const unsigned before = look_back(states, int(block.block), block_drawn);
    if (lane_index() == 0) block.base = before;
  }
  __syncthreads();
  return block.base + position;
}

// The last block to end tells the host.
__device__ __forceinline__ void publish(const Numbering& block, Counters* counters, Published* published) {
  if (threadIdx.x != 0) return;
  if (block.block == gridDim.x - 1) counters->splats = block.base + block.drawn;
  __threadfence();
  if (atomicAdd(&counters->project_done, 1u) != gridDim.x - 1) return;
  __threadfence();
  const volatile Counters* all = counters;
  published->splats = all->splats, published->pairs = int64_t(all->pairs);
  published->visible = all->visible, published->invalid = all->invalid;
  __threadfence_system();
}

}  // namespace sw::cuda
