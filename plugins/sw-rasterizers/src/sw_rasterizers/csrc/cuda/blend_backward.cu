// Backward compositing: a block of 4 warps a tile, a warp an 8 x 8 quarter of it, two pixels a lane.
//
// Pixels are walked back to front. For each splat that reaches the quarter a warp forms the sums over its 64 pixels
// with shuffles and adds them to the Gaussian's row, one atomic instruction for all sums. Because the conic is
// constant, moments of v = dL/dsigma are enough; the derivatives are put together in project_backward.
//
// A block walks a tile's whole list, or on small images a piece of it, from the state that `blend_few` kept there.
//
// kOrdered: the sums of the four warps are put together in shared memory and kept for each pair; a second kernel adds up
// those of each splat. No atomics, so that equal calls give equal bits; more memory and time.
#include <climits>

#include "../blend.h"
#include "groups.h"
#include "kernels.h"
#include "splat.h"
#include "warp_sums.h"

namespace sw::cuda {
namespace {

constexpr int kWarps = 4, kThreads = kWarps * kWarp, kWords = kThreads / kWarp;
constexpr int kPixels = 2;  // a lane: its pixel in each of the warp's two boxes

template <int kColors>
struct Pixel {
  float transmittance, behind;
  int last;
  float gradient[kColors];
};

// What `spread_sums` does, for the sums of the plain kernel, with 9 shuffles, and 11 for the two sums of absgrad. Lanes 8
// apart lie in one column of pixels and share dx, so the rows are added first, v, v dy, v dy^2, the colours and the two,
// and only then the first three are multiplied by dx and dx^2.
template <bool kAbsgrad>
__device__ __forceinline__ float column_sums(float v, float vy, float vyy, const float* color, float dx) {
  const bool upper = lane_index() & 16, odd_row = lane_index() & 8, odd = lane_index() & 1, second = lane_index() & 2;
  const auto swap = [](float x, int step) { return __shfl_xor_sync(kAllLanes, x, step); };
  const float k0 = (upper ? color[0] : v) + swap(upper ? v : color[0], 16);
  const float k1 = (upper ? color[1] : vy) + swap(upper ? vy : color[1], 16);
  const float k2 = (upper ? color[2] : vyy) + swap(upper ? vyy : color[2], 16);
  const float p = (odd_row ? k1 : k0) + swap(odd_row ? k0 : k1, 8), q = k2 + swap(k2, 8);
  const float e1 = p * dx, e2 = odd_row ? q : e1 * dx;
  const float one = (odd ? e1 : p) + swap(odd ? p : e1, 1);
  float other;
  if constexpr (kAbsgrad) {
    const float k3 = (upper ? color[4] : color[3]) + swap(upper ? color[3] : color[4], 16), r = k3 + swap(k3, 8);
    other = (odd ? e2 : r) + swap(odd ? r : e2, 1);
  } else {
    other = e2 + swap(e2, 1);
  }
  const bool takes_other = second && (odd || kAbsgrad), gives_other = !second && (odd || kAbsgrad);
  const float sum = (takes_other ? other : one) + swap(gives_other ? other : one, 2);
  return sum + swap(sum, 4);
}
template <bool kAbsgrad>
__device__ __forceinline__ int column_index(int lane) {
  if (lane & 4) return -1;
  constexpr int kNone = -1, kFirst = kAbsgrad ? 9 : kNone, kSecond = kAbsgrad ? 10 : kNone;
  // By row of lanes: p, p dx, r, e2.
  constexpr int kOf[4][4] = {
      {0, 1, kFirst, 3}, {2, 4, kNone, 5}, {6, kNone, kSecond, kNone}, {7, kNone, kNone, 8}};
  return kOf[lane / 8][lane & 3];
}

struct Chunk {  // the channels of one launch
  int first, count;
  int geometry;  // how many of them influence alpha
  bool alpha;    // the gradient of the alpha map enters here
};

// What a warp, and a pair, has sums of: moments, channels of the chunk, absgrad.
template <bool kGeneral, bool kAbsgrad>
struct Sums {
  static constexpr int kColors = kGeneral ? kMaxChunk : 3, kAt = kMomentSums + kColors;
  static constexpr int kCount = kAt + (kAbsgrad ? 2 : 0);

  // Column of the row: the moments, this chunk's channels, absgrad behind all channels; -1: nothing to add.
  __device__ static __forceinline__ int column(int index, const Chunk& chunk, int channels) {
    return index < 0 ? -1
           : index < kMomentSums ? index
           : index < kAt ? (index - kMomentSums < chunk.count ? chunk.first + index : -1)
                         : kMomentSums + channels + index - kAt;
  }
};

template <bool kGeneral, bool kAbsgrad, bool kOrdered>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(View<float> view, Splats splats, TileLists lists, Image image, ImageGradient gradient, Chunk chunk,
                    float clamp_limit, Rows rows, float* pair_sums) {
  using Layout = Sums<kGeneral, kAbsgrad>;
  constexpr int kColors = Layout::kColors, kAt = Layout::kAt, kSums = Layout::kCount;
  __shared__ float own[kOrdered ? kWarps : 1][kOrdered ? kThreads : 1][kSums];
  __shared__ float4 shape[2][kThreads];
  __shared__ float blue[kThreads];
  __shared__ int gaussian[kThreads];
  __shared__ float colors[kGeneral ? kThreads : 1][kGeneral ? kMaxChunk : 1];
  __shared__ unsigned words[kBoxes][kWords];
  __shared__ unsigned block_last;

  int tile = int(blockIdx.x), from = 0, to = INT_MAX;  // list positions of the block's pairs: [from, to)
  if (image.pieces.where != nullptr) {
    const int2 piece = image.pieces.where[blockIdx.x];
    if (piece.x < 0) return;
    tile = piece.x, from = piece.y, to = piece.y + kPiece;
  }
  const int tiles_x = view.tiles_x();
  const int begin = lists.start[tile];
  if (begin == lists.start[tile + 1]) return;
  const int x0 = tile % tiles_x * kTile, y0 = tile / tiles_x * kTile;
  const int first_box = warp_index() / kBoxColumns * kPixels * kBoxColumns + warp_index() % kBoxColumns;
  const int x = x0 + first_box % kBoxColumns * kBoxWidth + lane_index() % kBoxWidth;
  const int y = y0 + first_box / kBoxColumns * kBoxHeight + lane_index() / kBoxWidth;
  const int64_t size = int64_t(view.width) * view.height;
  const float centre_x = float(x) + 0.5f, centre_y = float(y) + 0.5f;

  Pixel<kColors> pixel[kPixels];
#pragma unroll
  for (int p = 0; p < kPixels; ++p) {
    Pixel<kColors>& state = pixel[p];
    state = {1.f, 0.f, 0, {}};
    const int row = y + p * kBoxHeight;
    if (x >= view.width || row >= view.height) continue;
    const int64_t at = int64_t(row) * view.width + x;
    state.transmittance = image.transmittance[at], state.last = image.last[at];
    float behind = chunk.alpha ? -gradient.alpha[at] : 0.f;
#pragma unroll
    for (int k = 0; k < kColors; ++k) {
      if (kGeneral && k >= chunk.count) break;
      const int channel = chunk.first + k;
      state.gradient[k] = gradient.image[channel * size + at];
      if (image.background != nullptr && channel < image.color_channels)
        behind += state.gradient[k] *
                  image.background[image.background_is_image ? channel * size + at : int64_t(channel)];
    }
    state.behind = state.transmittance * behind;
    if (state.last > to) {  // more is drawn behind this piece
      const int thread = (first_box + p * kBoxColumns) * kWarp + lane_index();
      const float4 kept = image.pieces.behind[int64_t(blockIdx.x) * (kTile * kTile) + thread];
      state.transmittance = kept.x;
      state.behind += kept.y * state.gradient[0] + kept.z * state.gradient[1] + kept.w * state.gradient[2];
      state.last = to;
    }
  }
  // How many pairs from the front matter to the warp, and to the block.
  const int warp_last = int(warp_max(unsigned(max(pixel[0].last, pixel[1].last))));
  if (threadIdx.x == 0) block_last = 0;
  __syncthreads();
  if (lane_index() == 0) atomicMax(&block_last, unsigned(warp_last));
  __syncthreads();

  const int index = kGeneral ? spread_index<kSums>(lane_index()) : column_index<kAbsgrad>(lane_index());
  const int column = Layout::column(index, chunk, rows.channels);

  for (int stop = int(block_last); stop > from; stop -= kThreads) {  // list positions [stop - kThreads, stop)
    unsigned mask = 0;
    const int position = stop - 1 - int(threadIdx.x);
    if (position >= from) {
      const int slot = lists.splat[begin + position];
      const float4 s0 = splats.shape[2 * int64_t(slot)], s1 = splats.shape[2 * int64_t(slot) + 1];
      const float2 tail = splats.tail[slot];
      mask = box_mask(s0.x, s0.y, s0.z, s0.w, s1.x, s1.y, x0, y0);
      shape[0][threadIdx.x] = s0, shape[1][threadIdx.x] = s1;
      blue[threadIdx.x] = tail.x, gaussian[threadIdx.x] = __float_as_int(tail.y);
      if constexpr (kGeneral)
        for (int k = 0; k < kMaxChunk; ++k)
          colors[threadIdx.x][k] =
              k < chunk.count ? splats.channels[int64_t(slot) * image.channels + chunk.first + k] : 0.f;
    }
    if constexpr (kOrdered)
      for (int w = 0; w < kWarps; ++w)
        for (int k = 0; k < kSums; ++k) own[w][threadIdx.x][k] = 0.f;
#pragma unroll
    for (int b = 0; b < kBoxes; ++b) {
      const unsigned word = __ballot_sync(kAllLanes, mask >> b & 1);
      if (lane_index() == b) words[b][warp_index()] = word;
    }
    __syncthreads();

    for (int w = 0; w < kWords; ++w) {
      const unsigned reached[kPixels] = {words[first_box][w], words[first_box + kBoxColumns][w]};
      unsigned word = reached[0] | reached[1];
      const int skipped = stop - warp_last - w * kWarp;  // entries at positions that no pixel of the warp got to
      if (skipped > 0) word = skipped < kWarp ? word & (kAllLanes << skipped) : 0;
      for (; word != 0; word &= word - 1) {
        const int bit = __ffs(int(word)) - 1, k = w * kWarp + bit, at = stop - 1 - k;
        const float4 s0 = shape[0][k], s1 = shape[1][k];
        const float dx = s0.x - centre_x;
        float color[kColors];
        if constexpr (kGeneral) {
#pragma unroll
          for (int channel = 0; channel < kMaxChunk; ++channel) color[channel] = colors[k][channel];
        } else {
          color[0] = s1.z, color[1] = s1.w, color[2] = blue[k];
        }
        float sums[kSums] = {};
        float v0 = 0.f, vy = 0.f, vyy = 0.f;
        bool any_touched = false;
#pragma unroll
        for (int p = 0; p < kPixels; ++p) {
          if (!(reached[p] >> bit & 1)) continue;
          Pixel<kColors>& state = pixel[p];
          const float dy = s0.y - (centre_y + float(p * kBoxHeight));
          const float power = log2_alpha(dx, dy, s0.z, s0.w, s1.x, s1.y);
          const bool touched = power >= float(kLog2AlphaMin) && state.last > at;
          if (!__any_sync(kAllLanes, touched)) continue;
          any_touched = true;
          const float unclamped = touched ? exp_2(power) : 0.f;
          float phi = 0.f, weight;
#pragma unroll
          for (int channel = 0; channel < kColors; ++channel)
            if (!kGeneral || channel < chunk.geometry) phi += color[channel] * state.gradient[channel];
          const float alpha_gradient = composite_backward(fminf(float(kAlphaMax), unclamped), phi,
                                                          state.transmittance, state.behind, weight);
#pragma unroll
          for (int channel = 0; channel < kColors; ++channel)
            sums[kMomentSums + channel] += weight * state.gradient[channel];
          // The clamp at 0.99 stops the gradient, unless it is asked to pass: then the unclamped alpha stands in front.
          const float moment = unclamped <= clamp_limit ? -(unclamped * alpha_gradient) : 0.f;
          const float along_y = moment * dy;
          v0 += moment, vy += along_y, vyy += along_y * dy;
          if constexpr (kAbsgrad) {
            if (rows.fragments) {
              sums[kAt] += moment * moment, sums[kAt + 1] += touched ? 1.f : 0.f;
            } else {  // A = -Ka log2(e)/2 and so on: back to natural units
              sums[kAt] += float(kLn2) * fabsf(2.f * s0.z * dx * moment + s0.w * along_y);
              sums[kAt + 1] += float(kLn2) * fabsf(s0.w * dx * moment + 2.f * s1.x * along_y);
            }
          }
        }
        if (!any_touched) continue;
        float total;
        if constexpr (!kGeneral) {
          total = column_sums<kAbsgrad>(v0, vy, vyy, sums + kMomentSums, dx);
        } else {
          sums[0] = v0, sums[1] = v0 * dx, sums[2] = vy, sums[3] = sums[1] * dx, sums[4] = vy * dx, sums[5] = vyy;
          total = spread_sums<kSums>(sums);
        }
        if constexpr (kOrdered) {
          if (index >= 0) own[warp_index()][k][index] = total;
        } else {
          if (column >= 0) atomicAdd(rows.base + int64_t(gaussian[k]) * rows.stride + column, total);
        }
      }
    }
    __syncthreads();
    if constexpr (kOrdered) {
      static_assert(kWarps == 4);
      if (position >= from) {
        float* to = pair_sums + (int64_t(begin) + position) * kSums;
        const int k = int(threadIdx.x);
        for (int i = 0; i < kSums; ++i) to[i] = (own[0][k][i] + own[1][k][i]) + (own[2][k][i] + own[3][k][i]);
      }
    }
  }
}

// Where the sums of a splat go: each has a row of its own.
template <bool kGeneral, bool kAbsgrad>
struct PutRow {
  const float2* tail;
  Chunk chunk;
  Rows rows;
  __device__ __forceinline__ void operator()(int64_t splat, int index, float total) const {
    const int column = Sums<kGeneral, kAbsgrad>::column(index, chunk, rows.channels);
    if (column >= 0) rows.base[int64_t(__float_as_int(tail[splat].y)) * rows.stride + column] += total;
  }
};
struct PutColumn {
  Rows rows;
  int column;
  __device__ __forceinline__ void operator()(int64_t gaussian, int, float total) const {
    rows.base[gaussian * rows.stride + column] += total;
  }
};

// The median depth is the depth of one splat: its pixel's gradient goes straight to that Gaussian.
__global__ void median_kernel(int64_t pixels, const int32_t* median_splat, const float* gradient, Rows rows,
                              int column) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < pixels && median_splat[i] >= 0) atomicAdd(rows.base + median_splat[i] * rows.stride + column, gradient[i]);
}

template <bool kGeneral, bool kAbsgrad>
void run_chunks(const View<float>& view, unsigned blocks, float clamp_limit, const Splats& splats,
                const TileLists& lists, const Image& image, const ImageGradient& gradient, int detached,
                const Rows& rows, const Ordered& ordered, cudaStream_t stream) {
  constexpr int kStep = Sums<kGeneral, kAbsgrad>::kColors, kSums = Sums<kGeneral, kAbsgrad>::kCount;
  const int geometry = image.channels - detached;
  for (int first = 0; first < image.channels; first += kStep) {
    const int count = image.channels - first < kStep ? image.channels - first : kStep;
    const int influence = geometry - first < 0 ? 0 : (geometry - first < count ? geometry - first : count);
    const Chunk chunk{first, count, influence, first == 0 && gradient.alpha != nullptr};
    if (ordered.pair_sums == nullptr) {
      backward_kernel<kGeneral, kAbsgrad, false><<<blocks, kThreads, 0, stream>>>(
          view, splats, lists, image, gradient, chunk, clamp_limit, rows, nullptr);
      continue;
    }
    // Zeros for the pairs that no block gets to.
    cudaMemsetAsync(ordered.pair_sums, 0, size_t(ordered.pairs) * kSums * sizeof(float), stream);
    backward_kernel<kGeneral, kAbsgrad, true><<<blocks, kThreads, 0, stream>>>(
        view, splats, lists, image, gradient, chunk, clamp_limit, rows, ordered.pair_sums);
    sum_groups<kSums>(ordered.splats, ordered.pairs_of_splat, ordered.pair_sums,
                      PutRow<kGeneral, kAbsgrad>{splats.tail, chunk, rows}, stream);
  }
}

}  // namespace

int pair_row_length(bool general, bool absgrad) {
  return general ? (absgrad ? Sums<true, true>::kCount : Sums<true, false>::kCount)
                 : (absgrad ? Sums<false, true>::kCount : Sums<false, false>::kCount);
}

void blend_backward(const View<float>& view, bool pass_clamp, const Splats& splats, const TileLists& lists,
                    const Image& image, bool general, const ImageGradient& gradient, int detached, const Rows& rows,
                    const Ordered& ordered, cudaStream_t stream) {
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const unsigned blocks = unsigned(image.pieces.where != nullptr ? image.pieces.count : tiles);
  const auto run = general ? (rows.absgrad ? run_chunks<true, true> : run_chunks<true, false>)
                           : (rows.absgrad ? run_chunks<false, true> : run_chunks<false, false>);
  run(view, blocks, pass_clamp ? 3e38f : float(kAlphaMax), splats, lists, image, gradient, detached, rows, ordered,
      stream);
  if (gradient.median == nullptr) return;
  const int column = row_length(rows.channels, rows.absgrad, true) - 1;
  if (ordered.pair_sums != nullptr) {
    sum_groups<1>(ordered.gaussians, ordered.pixels_of_gaussian, gradient.median, PutColumn{rows, column}, stream);
  } else {
    constexpr int kBlock = 256;
    const int64_t pixels = int64_t(view.width) * view.height;
    median_kernel<<<unsigned(ceil_div(pixels, kBlock)), kBlock, 0, stream>>>(pixels, image.median_splat,
                                                                             gradient.median, rows, column);
  }
}

}  // namespace sw::cuda
