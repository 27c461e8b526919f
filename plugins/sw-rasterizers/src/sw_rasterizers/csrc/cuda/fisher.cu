// How the image reacts to a splat, back to front as in `blend_backward`: squared derivatives, changes by its removal, and
// the Fisher blocks of the Gaussians from 28 sums a splat.
//
// A block of 4 warps takes a tile, a warp an 8 x 8 quarter of it, two pixels a lane.
#include "../blend.h"
#include "../sh.h"
#include "gather.h"
#include "groups.h"
#include "score_kernels.h"
#include "splat.h"
#include "warp_sums.h"

namespace sw::cuda {
namespace {

constexpr int kWarps = 4, kThreads = kWarps * kWarp, kWords = kThreads / kWarp;
constexpr int kPixels = 2;  // a lane: its pixel in each of the warp's two boxes

struct PixelState {
  float transmittance;
  float behind[3];
  int last;
  int64_t at;
};

// What one pixel adds to a score; `square` of dL/dalpha, `slope` [3], `at` the pixel of an image of `size`.
__device__ __forceinline__ float pixel_value(const Score<float>& score, float square, float alpha, const float* slope,
                                             int64_t at, int64_t size) {
  if (score.kind != kRemoval) return score.weight == nullptr ? square : square * score.weight[at];
  float residual[3] = {};
  if (score.weight != nullptr && alpha > 0.f) {
#pragma unroll
    for (int c = 0; c < 3; ++c) residual[c] = score.weight[c * size + at];
  }
  return removal_change(alpha, slope, residual);
}

// kForFisher: rows of sums a splat; else totals of the Gaussians. `pair_sums`, if given, takes each warp's part instead,
// of all sums of a row or of the one score.
template <bool kForFisher>
__global__ void __launch_bounds__(kThreads)
    sensitivity_kernel(View<float> view, Splats splats, TileLists lists, Image image, float clamp_limit, float* rows,
                       const __grid_constant__ Scores<float> scores, const __grid_constant__ Totals totals,
                       float* pair_sums) {
  __shared__ float4 shape[2][kThreads];
  __shared__ float blue[kThreads];
  __shared__ int target[kThreads];  // row of the splat, or Gaussian
  __shared__ unsigned words[kBoxes][kWords];
  __shared__ unsigned block_last;

  const int tile = int(blockIdx.x), tiles_x = view.tiles_x();
  const int begin = lists.start[tile];
  if (begin == lists.start[tile + 1]) return;
  const int x0 = tile % tiles_x * kTile, y0 = tile / tiles_x * kTile;
  const int first_box = warp_index() / kBoxColumns * kPixels * kBoxColumns + warp_index() % kBoxColumns;
  const int x = x0 + first_box % kBoxColumns * kBoxWidth + lane_index() % kBoxWidth;
  const int y = y0 + first_box / kBoxColumns * kBoxHeight + lane_index() / kBoxWidth;
  const int64_t size = int64_t(view.width) * view.height;
  const float centre_x = float(x) + 0.5f, centre_y = float(y) + 0.5f;

  PixelState pixel[kPixels];
#pragma unroll
  for (int p = 0; p < kPixels; ++p) {
    pixel[p] = {1.f, {}, 0, 0};
    const int row = y + p * kBoxHeight;
    if (x >= view.width || row >= view.height) continue;
    const int64_t at = int64_t(row) * view.width + x;
    pixel[p].at = at;
    pixel[p].transmittance = image.transmittance[at], pixel[p].last = image.last[at];
    if (image.background == nullptr) continue;
#pragma unroll
    for (int c = 0; c < 3; ++c)
      pixel[p].behind[c] =
          pixel[p].transmittance * image.background[image.background_is_image ? c * size + at : int64_t(c)];
  }
  const int warp_last = int(warp_max(unsigned(max(pixel[0].last, pixel[1].last))));
  if (threadIdx.x == 0) block_last = 0;
  __syncthreads();
  if (lane_index() == 0) atomicMax(&block_last, unsigned(warp_last));
  __syncthreads();
  const int column = kForFisher ? spread_index<kFisherSums>(lane_index()) : -1;

  for (int stop = int(block_last); stop > 0; stop -= kThreads) {  // list positions [stop - kThreads, stop)
    unsigned mask = 0;
    const int position = stop - 1 - int(threadIdx.x);
    if (position >= 0) {
      const int slot = lists.splat[begin + position];
      const float4 s0 = splats.shape[2 * int64_t(slot)], s1 = splats.shape[2 * int64_t(slot) + 1];
      const float2 tail = splats.tail[slot];
      mask = box_mask(s0.x, s0.y, s0.z, s0.w, s1.x, s1.y, x0, y0);
      shape[0][threadIdx.x] = s0, shape[1][threadIdx.x] = s1, blue[threadIdx.x] = tail.x;
      target[threadIdx.x] = kForFisher ? slot : __float_as_int(tail.y);
    }
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
        const float colors[3] = {s1.z, s1.w, blue[k]};
        float sums[kForFisher ? kFisherSums : 1] = {};
        float square[kPixels] = {}, alphas[kPixels] = {}, slopes[kPixels][3] = {};  // of scores
        bool any_touched = false;
#pragma unroll
        for (int p = 0; p < kPixels; ++p) {
          if (!(reached[p] >> bit & 1)) continue;
          PixelState& state = pixel[p];
          const float dy = s0.y - (centre_y + float(p * kBoxHeight));
          const float power = log2_alpha(dx, dy, s0.z, s0.w, s1.x, s1.y);
          const bool touched = power >= float(kLog2AlphaMin) && state.last > at;
          if (!__any_sync(kAllLanes, touched)) continue;
          any_touched = true;
          const float unclamped = touched ? exp_2(power) : 0.f, alpha = fminf(float(kAlphaMax), unclamped);
          const float gain = reciprocal(1.f - alpha);
          state.transmittance *= gain;
          const float weight = alpha * state.transmittance;
          const bool through = touched && unclamped <= clamp_limit;
          float slope[3];  // d image_c / d alpha
#pragma unroll
          for (int c = 0; c < 3; ++c) {
            slope[c] = state.transmittance * colors[c] - state.behind[c] * gain;
            state.behind[c] += weight * colors[c];
          }
          if constexpr (kForFisher) {
            const float factor = through ? -unclamped : 0.f;
            const float v[3] = {factor * slope[0], factor * slope[1], factor * slope[2]};
            add_fisher_pixel(dx, dy, v, weight, sums);
          } else {
            const float sum = through ? slope[0] + slope[1] + slope[2] : 0.f;
            square[p] = sum * sum, alphas[p] = alpha;
#pragma unroll
            for (int c = 0; c < 3; ++c) slopes[p][c] = slope[c];
          }
        }
        if (!any_touched) continue;
        if constexpr (kForFisher) {
          const float total = spread_sums<kFisherSums>(sums);
          if (column < 0) continue;
          if (pair_sums != nullptr)
            pair_sums[((int64_t(begin) + at) * kWarps + warp_index()) * kFisherSums + column] = total;
          else
            atomicAdd(rows + int64_t(target[k]) * kFisherSums + column, total);
        } else {
          const double opacity = exp_2(s1.y);
          for (int s = 0; s < scores.count; ++s) {
            float total = 0.f;
#pragma unroll
            for (int p = 0; p < kPixels; ++p)
              total += pixel_value(scores.of[s], square[p], alphas[p], slopes[p], pixel[p].at, size);
            total = spread_sums<1>(&total);
            if (lane_index() != 0 || total == 0.f) continue;
            const double found = scores.of[s].kind == kRemoval ? double(total) : opacity * opacity * total;
            if (pair_sums != nullptr)
              pair_sums[(int64_t(begin) + at) * kWarps + warp_index()] = float(found);
            else
              atomicAdd(totals.of[s] + target[k], found);
          }
        }
      }
    }
    __syncthreads();
  }
}

constexpr int kBlockThreads = 64, kBlockWarps = kBlockThreads / kWarp;

// A thread a splat. The colour's slopes are computed again from the coefficients.
__global__ void __launch_bounds__(kBlockThreads)
    blocks_kernel(View<float> view, Gaussians<float> g, Settings settings, int count, Splats splats,
                  const uint8_t* flags, const float* rows, double* blocks) {
  __shared__ float staged[kBlockWarps * kWarp * kRestFloats];
  const int slot = int(blockIdx.x * kBlockThreads + threadIdx.x);
  if (slot - lane_index() >= count) return;
  // Without a weight there is nothing to add, and the values may have no meaning.
  const bool drawn = slot < count && rows[int64_t(slot) * kFisherSums + kFisherSums - 1] > 0.f;
  const int64_t n = drawn ? __float_as_int(splats.tail[slot].y) : 0;
  const int degree = g.sh_dc != nullptr ? g.sh_degree : 0, active = (degree + 1) * (degree + 1);
  const float* rest = nullptr;
  if (degree > 0) rest = stage_rest(g, n, drawn, rest_floats(degree), staged + warp_index() * kWarp * kRestFloats);
  async_wait();
  __syncwarp();
  if (!drawn) return;

  Geometry<float> in;
  load_geometry<false>(g, n, in);
  double color[9] = {};
  if (degree > 0) {
    float direction[3], dx[kMaxBasis], dy[kMaxBasis], dz[kMaxBasis];
    const float inverse_length = view_direction(view, in.mean, direction);
    sh_basis_gradient(degree, direction[0], direction[1], direction[2], dx, dy, dz);
#pragma unroll
    for (int c = 0; c < 3; ++c) {
      float slope[3] = {};
#pragma unroll
      for (int k = 1; k < kMaxBasis; ++k) {
        if (k >= active) break;
        const float sh = rest[3 * (k - 1) + c];
        slope[0] += dx[k] * sh, slope[1] += dy[k] * sh, slope[2] += dz[k] * sh;
      }
      const float radial = dot3(direction, slope);
      const bool clamped = flags[n] >> c & 1;
      for (int j = 0; j < 3 && !clamped; ++j)
        color[3 * c + j] = double((slope[j] - direction[j] * radial) * inverse_length);
    }
  }
  float narrow[kTheta][kPositions];
  fisher_basis(view, in, float(settings.scale_modifier), float(settings.eps2d), settings.original_jacobian, narrow);
  double basis[kTheta][kPositions], sums[kFisherSums], block[kFisher];
  for (int a = 0; a < kTheta; ++a)
    for (int k = 0; k < kPositions; ++k) basis[a][k] = double(narrow[a][k]);
  for (int k = 0; k < kFisherSums; ++k) sums[k] = double(rows[int64_t(slot) * kFisherSums + k]);
  fisher_block(basis, sums, color, block);
  for (int k = 0; k < kFisher; ++k) blocks[n * kFisher + k] += block[k];
}

unsigned tiles_of(const View<float>& view) { return unsigned(view.tiles_x()) * unsigned(view.tiles_y()); }
float clamp_limit(bool pass_clamp) { return pass_clamp ? 3e38f : float(kAlphaMax); }

}  // namespace

void sensitivity_scores(const View<float>& view, bool pass_clamp, const Splats& splats, const TileLists& lists,
                        const Image& image, const Scores<float>& scores, const Totals& totals, const Ordered& ordered,
                        cudaStream_t stream) {
  if (ordered.pair_sums == nullptr) {
    sensitivity_kernel<false><<<tiles_of(view), kThreads, 0, stream>>>(
        view, splats, lists, image, clamp_limit(pass_clamp), nullptr, scores, totals, nullptr);
    return;
  }
  for (int s = 0; s < scores.count; ++s) {
    Scores<float> one;
    one.of[one.count++] = scores.of[s];
    cudaMemsetAsync(ordered.pair_sums, 0, size_t(ordered.pairs) * kWarps * sizeof(float), stream);
    sensitivity_kernel<false><<<tiles_of(view), kThreads, 0, stream>>>(
        view, splats, lists, image, clamp_limit(pass_clamp), nullptr, one, {}, ordered.pair_sums);
    sum_groups<1, kWarps>(ordered.splats, ordered.pairs_of_splat, ordered.pair_sums,
                          PutTotal{splats.tail, totals.of[s]}, stream);
  }
}

namespace {
struct PutFisher {
  float* rows;
  __device__ __forceinline__ void operator()(int64_t splat, int which, float total) const {
    rows[splat * kFisherSums + which] += total;
  }
};
}  // namespace

void fisher_sums(const View<float>& view, bool pass_clamp, const Splats& splats, const TileLists& lists,
                 const Image& image, float* rows, const Ordered& ordered, cudaStream_t stream) {
  static_assert(kFisherParts == kWarps);
  if (ordered.pair_sums != nullptr)
    cudaMemsetAsync(ordered.pair_sums, 0, size_t(ordered.pairs) * (kWarps * kFisherSums * sizeof(float)), stream);
  sensitivity_kernel<true><<<tiles_of(view), kThreads, 0, stream>>>(
      view, splats, lists, image, clamp_limit(pass_clamp), rows, {}, {}, ordered.pair_sums);
  if (ordered.pair_sums != nullptr)
    sum_groups<kFisherSums, kWarps>(ordered.splats, ordered.pairs_of_splat, ordered.pair_sums, PutFisher{rows}, stream);
}

void fisher_blocks(const View<float>& view, const Gaussians<float>& g, const Settings& settings, int count,
                   const Splats& splats, const uint8_t* flags, const float* rows, double* blocks,
                   cudaStream_t stream) {
  blocks_kernel<<<unsigned(ceil_div(count, kBlockThreads)), kBlockThreads, 0, stream>>>(view, g, settings, count,
                                                                                        splats, flags, rows, blocks);
}

}  // namespace sw::cuda
