// Sorting: radix sorts of CUB. Both are stable.
#include <cub/device/device_radix_sort.cuh>

#include "kernels.h"

namespace sw::cuda {

size_t depth_order(void* scratch, size_t bytes, int count, uint32_t* depth, uint32_t* depth_scratch, int32_t* order,
                   int32_t* order_scratch, int32_t** sorted, uint32_t** sorted_depth, cudaStream_t stream) {
  cub::DoubleBuffer<uint32_t> keys(depth, depth_scratch);
  cub::DoubleBuffer<int32_t> values(order, order_scratch);
  cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, values, count, 0, 32, stream);
  *sorted = values.Current();
  *sorted_depth = keys.Current();
  return bytes;
}

namespace {

template <class Key>
size_t sort_as(void* scratch, size_t bytes, int count, int key_bits, void* keys, void* keys_scratch, int32_t* values,
               int32_t* values_scratch, void** sorted_keys, int32_t** sorted_values, cudaStream_t stream) {
  cub::DoubleBuffer<Key> key_buffer(static_cast<Key*>(keys), static_cast<Key*>(keys_scratch));
  cub::DoubleBuffer<int32_t> value_buffer(values, values_scratch);
  cub::DeviceRadixSort::SortPairs(scratch, bytes, key_buffer, value_buffer, count, 0, key_bits, stream);
  *sorted_keys = key_buffer.Current();
  *sorted_values = value_buffer.Current();
  return bytes;
}

}  // namespace

size_t sort_pairs(void* scratch, size_t bytes, int count, int key_bits, bool wide, void* keys, void* keys_scratch,
                  int32_t* values, int32_t* values_scratch, void** sorted_keys, int32_t** sorted_values,
                  cudaStream_t stream) {
  const auto run = wide ? sort_as<uint32_t> : sort_as<uint16_t>;
  return run(scratch, bytes, count, key_bits, keys, keys_scratch, values, values_scratch, sorted_keys, sorted_values,
             stream);
}

}  // namespace sw::cuda
