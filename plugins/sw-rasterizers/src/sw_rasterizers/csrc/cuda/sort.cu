// Sorting: radix sorts of CUB. Both are stable.
#include <cub/device/device_radix_sort.cuh>

#include "kernels.h"

namespace sw::cuda {

namespace {

template <class Key>
void sort_as(void* scratch, size_t& bytes, int count, int key_bits, void* keys, void* keys_scratch, int32_t* values,
             int32_t* values_scratch, void** sorted_keys, int32_t** sorted_values, cudaStream_t stream) {
  cub::DoubleBuffer<Key> key_buffer(static_cast<Key*>(keys), static_cast<Key*>(keys_scratch));
  cub::DoubleBuffer<int32_t> value_buffer(values, values_scratch);
  cub::DeviceRadixSort::SortPairs(scratch, bytes, key_buffer, value_buffer, count, 0, key_bits, stream);
  if (sorted_keys != nullptr) *sorted_keys = key_buffer.Current();
  if (sorted_values != nullptr) *sorted_values = value_buffer.Current();
}

// To ask CUB costs as much host time as a launch, so it is asked once for all counts up to the next power of two; on
// each GPU, since the answer depends on how many multiprocessors it has.
template <class Key>
size_t scratch_bytes(int count) {
  constexpr int kGpus = 16;  // on further ones it is asked each time
  static thread_local size_t known[kGpus][32] = {};
  int bits = 0, gpu = kGpus;
  while (bits < 31 && (count >> bits) != 0) ++bits;
  cudaGetDevice(&gpu);
  size_t asked = 0;
  size_t& bytes = gpu < kGpus ? known[gpu][bits] : asked;
  if (bytes == 0)
    sort_as<Key>(nullptr, bytes, int((1u << bits) - 1), int(8 * sizeof(Key)), nullptr, nullptr, nullptr, nullptr,
                 nullptr, nullptr, nullptr);
  return bytes;
}

__global__ void number_kernel(int64_t count, const int32_t* keys, uint32_t none, uint32_t* to, int32_t* numbers) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < count) to[i] = keys[i] < 0 ? none : uint32_t(keys[i]), numbers[i] = int32_t(i);
}

}  // namespace

void number_keys(int64_t count, const int32_t* keys, uint32_t none, uint32_t* to, int32_t* numbers,
                 cudaStream_t stream) {
  constexpr int kThreads = 256;
  if (count > 0)
    number_kernel<<<unsigned((count + kThreads - 1) / kThreads), kThreads, 0, stream>>>(count, keys, none, to, numbers);
}

size_t depth_order_scratch(int count) { return scratch_bytes<uint32_t>(count); }

void depth_order(void* scratch, size_t bytes, int count, uint32_t* depth, uint32_t* depth_scratch, int32_t* order,
                 int32_t* order_scratch, int32_t** sorted, uint32_t** sorted_depth, cudaStream_t stream) {
  void* keys = nullptr;
  sort_as<uint32_t>(scratch, bytes, count, 32, depth, depth_scratch, order, order_scratch, &keys, sorted, stream);
  *sorted_depth = static_cast<uint32_t*>(keys);
}

size_t sort_pairs_scratch(int count, bool wide) {
  return wide ? scratch_bytes<uint32_t>(count) : scratch_bytes<uint16_t>(count);
}

void sort_pairs(void* scratch, size_t bytes, int count, int key_bits, bool wide, void* keys, void* keys_scratch,
                int32_t* values, int32_t* values_scratch, void** sorted_keys, int32_t** sorted_values,
                cudaStream_t stream) {
  const auto run = wide ? sort_as<uint32_t> : sort_as<uint16_t>;
  run(scratch, bytes, count, key_bits, keys, keys_scratch, values, values_scratch, sorted_keys, sorted_values, stream);
}

}  // namespace sw::cuda
