// Forward compositing on images of few tiles: too few warps to hide each other's waiting, so each hides its own.
//
// As blend.cu, but a warp takes kAhead splats of its box at a time, whose loads and exponentials do not wait for one
// another, and the block fetches the next stage while it composites this one. For the backward pass it leaves each
// pixel's state at the end of every piece of the list.
#include "../blend.h"
#include "kernels.h"
#include "splat.h"

namespace sw::cuda {
namespace {

constexpr int kThreads = kBoxes * kWarp, kAhead = 4;
constexpr int kLongWords = kThreads / 64;
static_assert(kThreads == kPiece && kThreads == kTile * kTile);

struct Splat {
  float4 s0, s1;
  float blue;
};

struct Stage {
  float4 shape[2][kThreads + 1];  // the last one draws nothing
  float blue[kThreads + 1];
  union {
    unsigned words[kBoxes][kThreads / kWarp];  // bit i of word w: splat 32 w + i reaches the box
    unsigned long long long_words[kBoxes][kLongWords];
  };

  __device__ __forceinline__ void set(int k, const Splat& splat) {
    shape[0][k] = splat.s0, shape[1][k] = splat.s1, blue[k] = splat.blue;
  }
};

__global__ void __launch_bounds__(kThreads) few_kernel(View<float> view, Splats splats, TileLists lists, Image image) {
  __shared__ Stage stage;
  __shared__ unsigned block_last;
  const int tile = int(blockIdx.x), tiles_x = view.tiles_x(), thread = int(threadIdx.x);
  const int x0 = tile % tiles_x * kTile, y0 = tile / tiles_x * kTile;
  const int box = warp_index();
  const int x = x0 + box % kBoxColumns * kBoxWidth + lane_index() % kBoxWidth;
  const int y = y0 + box / kBoxColumns * kBoxHeight + lane_index() / kBoxWidth;
  const bool inside = x < view.width && y < view.height, cut = image.pieces.where != nullptr;
  const float centre_x = float(x) + 0.5f, centre_y = float(y) + 0.5f;
  const int begin = lists.start[tile], end = lists.start[tile + 1];
  const int64_t piece = first_piece(tile, begin);
  float4* const kept = image.pieces.behind + piece * kThreads + thread;  // at a piece's end: a step of kThreads each

  float transmittance = inside ? 1.f : -1.f;  // negative: finished
  float color[3] = {};                        // of this piece, if cut
  int last = 0, ended = 0;                    // `ended`: pieces whose end has been passed

  const auto listed = [&](int position) { return position < end ? lists.splat[position] : -1; };
  const auto fetch = [&](int slot) {
    Splat splat{};
    if (slot >= 0)
      splat = {splats.shape[2 * int64_t(slot)], splats.shape[2 * int64_t(slot) + 1], splats.tail[slot].x};
    return splat;
  };
  if (thread == 0) stage.set(kThreads, {make_float4(0.f, 0.f, 0.f, 0.f), make_float4(0.f, -1e30f, 0.f, 0.f), 0.f});
  int slot = listed(begin + thread), ahead = listed(begin + kThreads + thread);
  Splat splat = fetch(slot);
  for (int first = begin; first < end; first += kThreads) {
    if (__syncthreads_and(transmittance < 0.f)) break;
    if (cut && first > begin) {
      kept[int64_t(ended++) * kThreads] = make_float4(fabsf(transmittance), color[0], color[1], color[2]);
      color[0] = color[1] = color[2] = 0.f;
    }
    unsigned mask = 0;
    if (slot >= 0) {
      stage.set(thread, splat);
      mask = box_mask(splat.s0.x, splat.s0.y, splat.s0.z, splat.s0.w, splat.s1.x, splat.s1.y, x0, y0);
    }
#pragma unroll
    for (int b = 0; b < kBoxes; ++b) {
      const unsigned word = __ballot_sync(kAllLanes, mask >> b & 1);
      if (lane_index() == b) stage.words[b][warp_index()] = word;
    }
    slot = ahead, splat = fetch(slot), ahead = listed(first + 2 * kThreads + thread);
    __syncthreads();

    for (int w = 0; w < kLongWords; ++w) {
      if (__all_sync(kAllLanes, transmittance < 0.f)) break;
      for (unsigned long long word = stage.long_words[box][w]; word != 0;) {
        int k[kAhead];
        float alpha[kAhead];
        float4 s1[kAhead];
#pragma unroll
        for (int i = 0; i < kAhead; ++i, word &= word - 1) k[i] = word != 0 ? 64 * w + __ffsll(word) - 1 : kThreads;
#pragma unroll
        for (int i = 0; i < kAhead; ++i) {
          const float4 s0 = stage.shape[0][k[i]];
          s1[i] = stage.shape[1][k[i]];
          const float power = log2_alpha(s0.x - centre_x, s0.y - centre_y, s0.z, s0.w, s1[i].x, s1[i].y);
          alpha[i] = power >= float(kLog2AlphaMin) ? fminf(float(kAlphaMax), exp_2(power)) : 0.f;
        }
#pragma unroll
        for (int i = 0; i < kAhead; ++i) {
          const float weight = composite(alpha[i], transmittance);
          if (weight > 0.f) last = first - begin + k[i] + 1;
          color[0] += weight * s1[i].z, color[1] += weight * s1[i].w, color[2] += weight * stage.blue[k[i]];
        }
      }
    }
  }

  if (cut) {
    if (thread == 0) block_last = 0;
    __syncthreads();
    const unsigned warp_last = warp_max(unsigned(last));
    if (lane_index() == 0) atomicMax(&block_last, warp_last);
    __syncthreads();
    // The last tile's are all that are left: pairs that no tile claims (emit.cu) have places, too.
    const int64_t next = tile + 1 < int(gridDim.x) ? first_piece(tile + 1, end) : image.pieces.count;
    const int places = int(next - piece);
    for (int i = thread; i < places; i += kThreads)
      image.pieces.where[piece + i] = i * kPiece < int(block_last) ? make_int2(tile, i * kPiece) : make_int2(-1, 0);
    // From the colours of each piece to those behind it.
    for (int i = ended - 1; i >= 0; --i) {
      float4& at = kept[int64_t(i) * kThreads];
      const float4 piece_state = at;
      at = make_float4(piece_state.x, color[0], color[1], color[2]);
      color[0] += piece_state.y, color[1] += piece_state.z, color[2] += piece_state.w;
    }
  }
  if (!inside) return;
  const int64_t size = int64_t(view.width) * view.height, pixel = int64_t(y) * view.width + x;
  transmittance = fabsf(transmittance);
#pragma unroll
  for (int k = 0; k < 3; ++k) {
    float value = color[k];
    if (image.background != nullptr)
      value += transmittance * image.background[image.background_is_image ? k * size + pixel : int64_t(k)];
    image.image[k * size + pixel] = value;
  }
  if (image.alpha != nullptr) image.alpha[pixel] = 1.f - transmittance;
  if (image.transmittance != nullptr) image.transmittance[pixel] = transmittance, image.last[pixel] = last;
}

}  // namespace

void blend_few(const View<float>& view, const Splats& splats, const TileLists& lists, const Image& image,
               cudaStream_t stream) {
  few_kernel<<<unsigned(view.tiles_x()) * unsigned(view.tiles_y()), kThreads, 0, stream>>>(view, splats, lists, image);
}

}  // namespace sw::cuda
