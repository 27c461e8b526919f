// Front-to-back compositing on images of few tiles: too few warps to hide each other's waiting, so each hides its own.
//
// As blend.cu, but a warp takes kAhead splats of its box at a time, whose loads and exponentials do not wait for one
// another. For the backward pass it leaves each pixel's state at the end of every piece of the list.
//
// few_kernel: a block a tile, which fetches the next stage while it composites this one. The longest list decides.
//
// split_kernel, for the fewest tiles: blocks take pieces, those of a tile in order. A block composites its piece from
// transmittance 1, hands on what the piece lets pass, learns from those before it how much light each pixel still had,
// and scales. Where a pixel is finished within the piece, its warp goes through the piece again, now with the rule for
// stopping; where the start is known at once, the first time is enough. Both ways give the same bits, so that it does
// not matter who takes what when. The last block to be done with a tile puts its pieces together.
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
  __device__ __forceinline__ void set_nothing() {
    set(kThreads, {make_float4(0.f, 0.f, 0.f, 0.f), make_float4(0.f, -1e30f, 0.f, 0.f), 0.f});
  }
  // By all threads, a splat each.
  __device__ __forceinline__ void fill(bool used, const Splat& splat, int x0, int y0) {
    unsigned mask = 0;
    if (used) {
      set(int(threadIdx.x), splat);
      mask = box_mask(splat.s0.x, splat.s0.y, splat.s0.z, splat.s0.w, splat.s1.x, splat.s1.y, x0, y0);
    }
#pragma unroll
    for (int b = 0; b < kBoxes; ++b) {
      const unsigned word = __ballot_sync(kAllLanes, mask >> b & 1);
      if (lane_index() == b) words[b][warp_index()] = word;
    }
  }
};

struct Pixel {
  int x, y;
  bool inside;

  __device__ __forceinline__ Pixel(const View<float>& view, int x0, int y0) {
    const int box = warp_index();
    x = x0 + box % kBoxColumns * kBoxWidth + lane_index() % kBoxWidth;
    y = y0 + box / kBoxColumns * kBoxHeight + lane_index() / kBoxWidth;
    inside = x < view.width && y < view.height;
  }
};

__device__ __forceinline__ Splat fetch(const Splats& splats, int slot) {
  Splat splat{};
  if (slot >= 0) splat = {splats.shape[2 * int64_t(slot)], splats.shape[2 * int64_t(slot) + 1], splats.tail[slot].x};
  return splat;
}

// By all lanes of a warp: the stage's splats that reach its box. `before`: list positions in front of the stage.
__device__ __forceinline__ void composite_stage(const Stage& stage, const Pixel& pixel, int before, float least,
                                                float& transmittance, float (&color)[3], int& last) {
  const float centre_x = float(pixel.x) + 0.5f, centre_y = float(pixel.y) + 0.5f;
  const int box = warp_index();
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
        const float weight = composite(alpha[i], transmittance, least);
        if (weight > 0.f) last = before + k[i] + 1;
        color[0] += weight * s1[i].z, color[1] += weight * s1[i].w, color[2] += weight * stage.blue[k[i]];
      }
    }
  }
}

// By all threads of a block: which pieces of the tile the backward pass has to do. Followed by __syncthreads where
// `block_last` is used again.
__device__ __forceinline__ void tell_where(const TileLists& lists, const Pieces& pieces, int tile, int tiles, int last,
                                           unsigned& block_last) {
  if (threadIdx.x == 0) block_last = 0;
  __syncthreads();
  const unsigned warp_last = warp_max(unsigned(last));
  if (lane_index() == 0) atomicMax(&block_last, warp_last);
  __syncthreads();
  // The last tile's are all that are left: pairs that no tile claims (emit.cu) have places, too.
  const int64_t piece = first_piece(tile, lists.start[tile]);
  const int64_t next = tile + 1 < tiles ? first_piece(tile + 1, lists.start[tile + 1]) : pieces.count;
  const int places = int(next - piece);
  for (int i = int(threadIdx.x); i < places; i += kThreads)
    pieces.where[piece + i] = i * kPiece < int(block_last) ? make_int2(tile, i * kPiece) : make_int2(-1, 0);
}

__device__ __forceinline__ void finish(const View<float>& view, const Image& image, const Pixel& pixel,
                                       float transmittance, const float (&color)[3], int last) {
  if (!pixel.inside) return;
  const int64_t size = int64_t(view.width) * view.height, at = int64_t(pixel.y) * view.width + pixel.x;
#pragma unroll
  for (int k = 0; k < 3; ++k) {
    float value = color[k];
    if (image.background != nullptr)
      value += transmittance * image.background[image.background_is_image ? k * size + at : int64_t(k)];
    image.image[k * size + at] = value;
  }
  if (image.alpha != nullptr) image.alpha[at] = 1.f - transmittance;
  if (image.transmittance != nullptr) image.transmittance[at] = transmittance, image.last[at] = last;
}

__global__ void __launch_bounds__(kThreads) few_kernel(View<float> view, Splats splats, TileLists lists, Image image) {
  __shared__ Stage stage;
  __shared__ unsigned block_last;
  const int tile = int(blockIdx.x), tiles_x = view.tiles_x(), thread = int(threadIdx.x);
  const int x0 = tile % tiles_x * kTile, y0 = tile / tiles_x * kTile;
  const Pixel pixel(view, x0, y0);
  const bool cut = image.pieces.where != nullptr;
  const int begin = lists.start[tile], end = lists.start[tile + 1];
  float4* const kept =  // at a piece's end: a step of kThreads each
      image.pieces.behind + first_piece(tile, begin) * kThreads + thread;

  float transmittance = pixel.inside ? 1.f : -1.f;  // negative: finished
  float color[3] = {};                              // of this piece, if cut
  int last = 0, ended = 0;                          // `ended`: pieces whose end has been passed

  const auto listed = [&](int position) { return position < end ? lists.splat[position] : -1; };
  if (thread == 0) stage.set_nothing();
  int slot = listed(begin + thread), ahead = listed(begin + kThreads + thread);
  Splat splat = fetch(splats, slot);
  for (int first = begin; first < end; first += kThreads) {
    if (__syncthreads_and(transmittance < 0.f)) break;
    if (cut && first > begin) {
      kept[int64_t(ended++) * kThreads] = make_float4(fabsf(transmittance), color[0], color[1], color[2]);
      color[0] = color[1] = color[2] = 0.f;
    }
    stage.fill(slot >= 0, splat, x0, y0);
    slot = ahead, splat = fetch(splats, slot), ahead = listed(first + 2 * kThreads + thread);
    __syncthreads();
    composite_stage(stage, pixel, first - begin, float(kTransmittanceMin), transmittance, color, last);
  }

  if (cut) {
    tell_where(lists, image.pieces, tile, int(gridDim.x), last, block_last);
    // From the colours of each piece to those behind it.
    for (int i = ended - 1; i >= 0; --i) {
      float4& at = kept[int64_t(i) * kThreads];
      const float4 piece_state = at;
      at = make_float4(piece_state.x, color[0], color[1], color[2]);
      color[0] += piece_state.y, color[1] += piece_state.z, color[2] += piece_state.w;
    }
  }
  finish(view, image, pixel, fabsf(transmittance), color, last);
}

// What the blocks of split_kernel tell one another. All zeros at the start.
struct Shared {
  unsigned long long* progress;  // [tiles] pieces done, and in the upper half how many there are to do once it is known
  unsigned* passed;              // [pieces][kThreads] what a pixel's light has come to: below
  int* last;                     // [tiles][kThreads]
  int* next;                     // [tiles] the piece to be taken next; may run past the number of them

  Shared(void* scratch, int64_t tiles, int64_t pieces) {
    progress = static_cast<unsigned long long*>(scratch);
    passed = reinterpret_cast<unsigned*>(progress + tiles);
    last = reinterpret_cast<int*>(passed + pieces * kThreads), next = last + tiles * kThreads;
  }
  static size_t bytes(int64_t tiles, int64_t pieces) {
    return size_t(tiles * 8 + pieces * kThreads * 4 + tiles * kThreads * 4 + tiles * 4);
  }
};

// `passed` of a pixel, in one word, so that no flag has to be waited for: 0 is nothing yet; the bits of a float up to 1
// alone are what the piece lets pass; with kFromFront, the transmittance at the piece's end; with kFinished, the pixel
// is finished there.
constexpr unsigned kFromFront = 1u << 30, kFinished = 1u << 31;
constexpr float kLeastPassed = 1.2e-38f;  // not 0; a pixel with so little is finished, whatever came before
constexpr int kWindow = 8;                // words that are asked for together

__device__ __forceinline__ unsigned load_passed(const unsigned* at) {
  return *reinterpret_cast<const volatile unsigned*>(at);
}
__device__ __forceinline__ void store_passed(unsigned* at, unsigned value) {
  *reinterpret_cast<volatile unsigned*>(at) = value;
}

// What the piece behind a transmittance must let pass, lest the pixel be finished in it.
__device__ __forceinline__ float least_passed(float transmittance) {
  return __fdiv_rn(float(kTransmittanceMin), transmittance);
}

// By all lanes of a warp: transmittance where `piece` of a tile starts, -1: finished. `passed`: the pixel's words of
// the tile. Products are taken from the front, whoever takes them: equal bits. Without `wait`, returns false if a piece
// before this one has not come so far; -1 is right even then.
__device__ __forceinline__ bool find_start(const unsigned* passed, int piece, bool wait, float& transmittance) {
  unsigned word[kWindow];
  int from = 0;  // `transmittance` is that at the start of this piece
  bool found = false;
  for (int stop = piece; stop > 0 && !found; stop -= kWindow) {
#pragma unroll
    for (int i = 0; i < kWindow; ++i)
      word[i] = stop - 1 - i >= 0 ? load_passed(passed + int64_t(stop - 1 - i) * kThreads) : 0;
#pragma unroll
    for (int i = 0; i < kWindow; ++i)
      if (!found && __all_sync(kAllLanes, word[i] >= kFromFront)) {
        found = true, from = stop - i;
        transmittance = word[i] & kFinished ? -1.f : __uint_as_float(word[i] & ~kFromFront);
      }
  }
  for (; from < piece; from += kWindow) {
#pragma unroll
    for (int i = 0; i < kWindow; ++i)
      word[i] = from + i < piece ? load_passed(passed + int64_t(from + i) * kThreads) : 0;
#pragma unroll
    for (int i = 0; i < kWindow; ++i) {
      if (from + i >= piece) break;
      // The pieces behind the one that finishes a tile may be left out: nobody waits for them.
      if (__all_sync(kAllLanes, transmittance < 0.f)) return true;
      while (__any_sync(kAllLanes, word[i] == 0)) {
        if (!wait) return false;
#if __CUDA_ARCH__ >= 700
        __nanosleep(100);
#endif
        word[i] = load_passed(passed + int64_t(from + i) * kThreads);
      }
      if (word[i] & kFinished) {
        transmittance = -1.f;
      } else if (word[i] & kFromFront) {
        transmittance = __uint_as_float(word[i] & ~kFromFront);
      } else if (transmittance >= 0.f) {
        const float share = __uint_as_float(word[i]);
        transmittance = share >= least_passed(transmittance) ? __fmul_rn(transmittance, share) : -1.f;
      }
    }
  }
  return true;
}

// By all threads of a block, after all of a tile's pieces: `count` of them, behind which every pixel is finished.
__device__ __forceinline__ void join_pieces(const View<float>& view, const TileLists& lists, const Image& image,
                                            const Shared& shared, int tile, int count, const Pixel& pixel,
                                            unsigned& block_last) {
  const int thread = int(threadIdx.x);
  const bool cut = image.pieces.where != nullptr;
  float4* const kept = image.pieces.behind + first_piece(tile, lists.start[tile]) * kThreads + thread;
  const int last = __ldcg(shared.last + int64_t(tile) * kThreads + thread);
  if (cut) tell_where(lists, image.pieces, tile, view.tiles_x() * view.tiles_y(), last, block_last);
  float transmittance = 0.f, color[3] = {};
  for (int stop = count; stop > 0; stop -= kWindow) {  // back to front, so that small sums are added up first
    float4 state[kWindow];
#pragma unroll
    for (int i = 0; i < kWindow; ++i)
      state[i] = stop - 1 - i >= 0 ? __ldcg(kept + int64_t(stop - 1 - i) * kThreads) : make_float4(0.f, 0.f, 0.f, 0.f);
#pragma unroll
    for (int i = 0; i < kWindow; ++i) {
      if (stop - 1 - i < 0) break;
      if (cut) kept[int64_t(stop - 1 - i) * kThreads] = make_float4(state[i].x, color[0], color[1], color[2]);
      if (transmittance == 0.f) transmittance = state[i].x;  // 0: finished in a piece before
      color[0] += state[i].y, color[1] += state[i].z, color[2] += state[i].w;
    }
  }
  finish(view, image, pixel, transmittance, color, last);
}

constexpr int kSplitBlocks = 4;  // of a multiprocessor

__global__ void __launch_bounds__(kThreads, kSplitBlocks)
    split_kernel(View<float> view, Splats splats, TileLists lists, Image image, Shared shared) {
  __shared__ Stage stage;
  __shared__ unsigned block_last, nearest;
  __shared__ int2 taken;  // tile and piece, -1: none
  __shared__ int joined;  // pieces of a tile that is done, 0: it is not
  const int tiles_x = view.tiles_x(), tiles = tiles_x * view.tiles_y(), thread = int(threadIdx.x);
  const int search = int(int64_t(blockIdx.x) * 61 % tiles);  // not all at the same tile
  const auto pieces_of = [&](int t) { return max(1, (lists.start[t + 1] - lists.start[t] + kPiece - 1) / kPiece); };
  const auto take = [&](int t) {
    const int piece = atomicAdd(shared.next + t, 1);
    taken = make_int2(t, piece < pieces_of(t) ? piece : -1), nearest = unsigned(tiles);
  };
  if (thread == 0) stage.set_nothing();
  for (int tile = int(blockIdx.x) % tiles;;) {
    // A piece is waited for only by those behind it, and once it is taken its block runs: somebody always gets on.
    if (thread == 0) take(tile);
    __syncthreads();
    while (taken.y < 0) {
      for (int i = thread; i < tiles; i += kThreads) {
        const int t = (search + i) % tiles;
        if (*reinterpret_cast<volatile int*>(shared.next + t) >= pieces_of(t)) continue;
        atomicMin(&nearest, unsigned(i));
        break;
      }
      __syncthreads();
      const int chosen = int(nearest);
      __syncthreads();
      if (chosen == tiles) return;
      if (thread == 0) take((search + chosen) % tiles);
      __syncthreads();
    }
    tile = taken.x;
    const int piece = taken.y, x0 = tile % tiles_x * kTile, y0 = tile / tiles_x * kTile;
    const Pixel pixel(view, x0, y0);
    const int begin = lists.start[tile], position = begin + piece * kPiece + thread;
    const int slot = position < lists.start[tile + 1] ? lists.splat[position] : -1;
    const Splat splat = fetch(splats, slot);
    const int64_t place = first_piece(tile, begin);
    unsigned* const passed = shared.passed + place * kThreads + thread;

    float start = pixel.inside ? 1.f : -1.f;
    bool known = find_start(passed, piece, false, start);
    if (__syncthreads_and(start < 0.f)) continue;
    stage.fill(slot >= 0, splat, x0, y0);
    __syncthreads();

    float transmittance, color[3];  // relative to the start
    int last;
    while (true) {
      transmittance = start < 0.f ? -1.f : 1.f;
      color[0] = color[1] = color[2] = 0.f, last = 0;
      composite_stage(stage, pixel, piece * kPiece, known ? least_passed(fabsf(start)) : kLeastPassed, transmittance,
                      color, last);
      if (known) break;
      store_passed(passed + int64_t(piece) * kThreads, __float_as_uint(fmaxf(fabsf(transmittance), kLeastPassed)));
      start = pixel.inside ? 1.f : -1.f;
      known = find_start(passed, piece, true, start);
      if (!__any_sync(kAllLanes, start >= 0.f && fabsf(transmittance) < least_passed(start))) break;
    }
    const bool drawn = start >= 0.f, going_on = drawn && transmittance >= 0.f;
    const float end = drawn ? __fmul_rn(start, fabsf(transmittance)) : 0.f;
    store_passed(passed + int64_t(piece) * kThreads,
                 __float_as_uint(end) | kFromFront | (going_on ? 0u : kFinished));
    const float scale = drawn ? start : 0.f;
    image.pieces.behind[(place + piece) * kThreads + thread] =
        make_float4(end, scale * color[0], scale * color[1], scale * color[2]);
    if (image.last != nullptr && drawn && last > 0) atomicMax(shared.last + int64_t(tile) * kThreads + thread, last);
    __threadfence();
    if (!__syncthreads_or(drawn)) continue;  // an earlier piece was the last
    const bool closed = !__syncthreads_or(going_on);
    if (thread == 0) {
      const int all = pieces_of(tile);
      if (closed) atomicMax(shared.next + tile, all);
      const unsigned long long to_do = closed || piece + 1 == all ? unsigned(piece + 1) : 0u;
      const unsigned long long step = to_do << 32 | 1;
      const unsigned long long now = atomicAdd(shared.progress + tile, step) + step;
      joined = unsigned(now >> 32) == unsigned(now) ? int(unsigned(now)) : 0;
      __threadfence();
    }
    __syncthreads();
    if (joined > 0) join_pieces(view, lists, image, shared, tile, joined, pixel, block_last);
  }
}

}  // namespace

size_t few_scratch(int64_t tiles, int64_t pieces) { return Shared::bytes(tiles, pieces); }

void blend_few(void* scratch, const View<float>& view, const Splats& splats, const TileLists& lists, const Image& image,
               cudaStream_t stream) {
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y(), pieces = image.pieces.count;
  if (scratch == nullptr) {
    few_kernel<<<unsigned(tiles), kThreads, 0, stream>>>(view, splats, lists, image);
    return;
  }
  int device = 0, processors = 1;
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device);
  const unsigned blocks = unsigned(pieces < processors * kSplitBlocks ? pieces : processors * kSplitBlocks);
  cudaMemsetAsync(scratch, 0, Shared::bytes(tiles, pieces), stream);
  split_kernel<<<blocks, kThreads, 0, stream>>>(view, splats, lists, image, Shared(scratch, tiles, pieces));
}

}  // namespace sw::cuda
