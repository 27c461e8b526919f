// L1 and SSIM of two images, and the gradient with respect to the first one.
//
//   mx=blur(x) my=blur(y) sx=blur(x^2)-mx^2 sy=blur(y^2)-my^2 sxy=blur(xy)-mx my
//   A=mx^2+my^2+C1  B=sx+sy+C2  C=2 mx my+C1  D=2 sxy+C2      ssim = C D/(A B)
// The window, 11 x 11 Gaussian, is separable. A block takes 32 x 32 pixels of a plane with 5 more around: rows are
// blurred from shared memory into shared memory, four neighbours a thread, then columns, four rows a thread, so that a
// value is read from shared memory for four results. The forward pass leaves the three slopes of each window; the
// backward pass blurs them (the blur is its own adjoint) and puts the gradient together:
//   d/dx = blur(p1) + 2 x blur(p2) + y blur(p3)
#include "kernels.h"

namespace splatwizard::cuda {
namespace {

constexpr int kRadius = 5, kTaps = 2 * kRadius + 1;
constexpr int kTile = 32, kHalo = kTile + 2 * kRadius;
constexpr int kPitch = 44;  // of a row with halo: whole float4s
constexpr int kRows = 4, kThreads = kTile * kTile / kRows;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

__device__ __forceinline__ constexpr float weight(int i) {  // Gaussian, sigma 1.5, sum 1
  constexpr float values[kTaps] = {0.00102838008f, 0.00759875814f, 0.0360007721f, 0.10936069f, 0.213005538f,
                                   0.266011725f, 0.213005538f, 0.10936069f, 0.0360007721f, 0.00759875814f,
                                   0.00102838008f};
  return values[i];
}

struct Place {  // of a block in its plane
  int x0, y0;
  int64_t plane;
};
__device__ __forceinline__ Place place(const Photometric& a) {
  return {int(blockIdx.x) * kTile, int(blockIdx.y) * kTile, int64_t(blockIdx.z) * a.height * a.width};
}

// A plane's tile with halo, zeros outside the image.
__device__ __forceinline__ void load_tile(const Photometric& a, const Place& at, const float* plane,
                                          float (*to)[kPitch]) {
  for (int i = int(threadIdx.x); i < kHalo * kHalo; i += kThreads) {
    const int row = i / kHalo, column = i % kHalo, y = at.y0 + row - kRadius, x = at.x0 + column - kRadius;
    const bool inside = x >= 0 && x < a.width && y >= 0 && y < a.height;
    to[row][column] = inside ? plane[int64_t(y) * a.width + x] : 0.f;
  }
}

// Four neighbouring results of the horizontal blur from 14 values.
__device__ __forceinline__ float4 blur_four(const float* values) {
  float sums[4] = {};
#pragma unroll
  for (int j = 0; j < 4; ++j)
#pragma unroll
    for (int i = 0; i < kTaps; ++i) sums[j] += weight(i) * values[j + i];
  return make_float4(sums[0], sums[1], sums[2], sums[3]);
}
__device__ __forceinline__ void read_sixteen(const float* row, float* values) {
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const float4 four = reinterpret_cast<const float4*>(row)[i];
    values[4 * i] = four.x, values[4 * i + 1] = four.y, values[4 * i + 2] = four.z, values[4 * i + 3] = four.w;
  }
}
// kRows results of the vertical blur at one column.
__device__ __forceinline__ void blur_column(const float (*from)[kTile], int first_row, int column, float* sums) {
  float values[kRows + kTaps - 1];
#pragma unroll
  for (int i = 0; i < kRows + kTaps - 1; ++i) values[i] = from[first_row + i][column];
#pragma unroll
  for (int j = 0; j < kRows; ++j) {
    sums[j] = 0.f;
#pragma unroll
    for (int i = 0; i < kTaps; ++i) sums[j] += weight(i) * values[j + i];
  }
}

constexpr int kTasks = kHalo * kTile / 4;  // of the horizontal blur

__global__ void __launch_bounds__(kThreads)
    forward_kernel(Photometric a, PhotometricSums sums, PhotometricMeans means, float ssim_scale) {
  __shared__ __align__(16) float x_tile[kHalo][kPitch], y_tile[kHalo][kPitch];
  __shared__ __align__(16) float moments[5][kHalo][kTile];  // x, y, x^2, y^2, xy, blurred along rows
  __shared__ float partial[2][kThreads / 32];
  const Place at = place(a);
  load_tile(a, at, a.x + at.plane, x_tile);
  load_tile(a, at, a.y + at.plane, y_tile);
  __syncthreads();
  for (int task = int(threadIdx.x); task < kTasks; task += kThreads) {
    const int row = task / (kTile / 4), column = task % (kTile / 4) * 4;
    float x[16], y[16], product[14];
    read_sixteen(x_tile[row] + column, x);
    read_sixteen(y_tile[row] + column, y);
    const auto put = [&](int which, const float* values) {
      *reinterpret_cast<float4*>(&moments[which][row][column]) = blur_four(values);
    };
    put(0, x);
    put(1, y);
#pragma unroll
    for (int i = 0; i < 14; ++i) product[i] = x[i] * x[i];
    put(2, product);
#pragma unroll
    for (int i = 0; i < 14; ++i) product[i] = y[i] * y[i];
    put(3, product);
#pragma unroll
    for (int i = 0; i < 14; ++i) product[i] = x[i] * y[i];
    put(4, product);
  }
  __syncthreads();

  const int column = int(threadIdx.x) % kTile, first_row = int(threadIdx.x) / kTile * kRows;
  float moment[5][kRows];
#pragma unroll
  for (int k = 0; k < 5; ++k) blur_column(moments[k], first_row, column, moment[k]);
  const int lost = a.valid ? kRadius : 0, x = at.x0 + column;
  const int64_t size = int64_t(a.planes) * a.height * a.width;
  float l1 = 0.f, ssim = 0.f;
#pragma unroll
  for (int j = 0; j < kRows; ++j) {
    const int y = at.y0 + first_row + j;
    if (x >= a.width || y >= a.height) continue;
    l1 += fabsf(x_tile[first_row + j + kRadius][column + kRadius] - y_tile[first_row + j + kRadius][column + kRadius]);
    const float mx = moment[0][j], my = moment[1][j];
    const float mxx = mx * mx, myy = my * my, mxy = mx * my;
    const float A = mxx + myy + kC1, B = moment[2][j] - mxx + moment[3][j] - myy + kC2;
    const float C = 2.f * mxy + kC1, D = 2.f * (moment[4][j] - mxy) + kC2;
    const float inverse_a = 1.f / A, inverse_b = 1.f / B, map = C * D * inverse_a * inverse_b;
    const bool counts = x >= lost && x < a.width - lost && y >= lost && y < a.height - lost;
    if (counts) ssim += map;
    if (a.slopes != nullptr) {
      const float scale = counts ? ssim_scale : 0.f, both = scale * inverse_a * inverse_b;
      float* to = a.slopes + at.plane + int64_t(y) * a.width + x;
      to[0] = 2.f * both * my * (D - C) - 2.f * scale * mx * map * (inverse_a - inverse_b);
      to[size] = -scale * map * inverse_b;
      to[2 * size] = 2.f * both * C;
    }
  }
#pragma unroll
  for (int step = 16; step > 0; step /= 2) {
    l1 += __shfl_xor_sync(0xffffffffu, l1, step);
    ssim += __shfl_xor_sync(0xffffffffu, ssim, step);
  }
  if (threadIdx.x % 32 == 0) partial[0][threadIdx.x / 32] = l1, partial[1][threadIdx.x / 32] = ssim;
  __syncthreads();
  const unsigned blocks = gridDim.x * gridDim.y * gridDim.z;
  __shared__ bool is_last;
  if (threadIdx.x == 0) {
    for (int w = 1; w < kThreads / 32; ++w) l1 += partial[0][w], ssim += partial[1][w];
    sums.of_block[(blockIdx.z * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x] = make_float2(l1, ssim);
    __threadfence();
    is_last = atomicAdd(sums.blocks_done, 1u) == blocks - 1;
  }
  __syncthreads();
  if (!is_last) return;
  // The last block adds up those of all, in one order: equal images give equal bits.
  __threadfence();
  double total[2] = {};
  for (unsigned i = threadIdx.x; i < blocks; i += kThreads) {
    const float2 block = __ldcg(sums.of_block + i);
    total[0] += double(block.x), total[1] += double(block.y);
  }
  __shared__ double totals[2][kThreads / 32];
#pragma unroll
  for (int k = 0; k < 2; ++k) {
    for (int step = 16; step > 0; step /= 2) total[k] += __shfl_xor_sync(0xffffffffu, total[k], step);
    if (threadIdx.x % 32 == 0) totals[k][threadIdx.x / 32] = total[k];
  }
  __syncthreads();
  if (threadIdx.x != 0) return;
  for (int w = 1; w < kThreads / 32; ++w) total[0] += totals[0][w], total[1] += totals[1][w];
  const double pixels = double(a.planes) * a.height * a.width;
  const double counted = double(a.planes) * (a.height - 2 * lost) * (a.width - 2 * lost);
  const double mean_l1 = total[0] / pixels, mean_ssim = total[1] / counted;
  *means.total = float(a.l1_weight * mean_l1 + a.ssim_weight * mean_ssim + a.offset);
  *means.l1 = float(mean_l1), *means.ssim = float(mean_ssim);
}

__global__ void __launch_bounds__(kThreads)
    backward_kernel(Photometric a, float* grad, float l1_scale) {
  __shared__ __align__(16) float tile[kHalo][kPitch];
  __shared__ __align__(16) float blurred[3][kHalo][kTile];
  const Place at = place(a);
  const int64_t size = int64_t(a.planes) * a.height * a.width;
  for (int k = 0; k < 3; ++k) {
    if (k > 0) __syncthreads();
    load_tile(a, at, a.slopes + k * size + at.plane, tile);
    __syncthreads();
    for (int task = int(threadIdx.x); task < kTasks; task += kThreads) {
      const int row = task / (kTile / 4), column = task % (kTile / 4) * 4;
      float values[16];
      read_sixteen(tile[row] + column, values);
      *reinterpret_cast<float4*>(&blurred[k][row][column]) = blur_four(values);
    }
  }
  __syncthreads();
  const int column = int(threadIdx.x) % kTile, first_row = int(threadIdx.x) / kTile * kRows, x = at.x0 + column;
  float sums[3][kRows];
#pragma unroll
  for (int k = 0; k < 3; ++k) blur_column(blurred[k], first_row, column, sums[k]);
#pragma unroll
  for (int j = 0; j < kRows; ++j) {
    const int y = at.y0 + first_row + j;
    if (x >= a.width || y >= a.height) continue;
    const int64_t i = at.plane + int64_t(y) * a.width + x;
    const float of_x = a.x[i], of_y = a.y[i], difference = of_x - of_y;
    const float sign = difference > 0.f ? l1_scale : (difference < 0.f ? -l1_scale : 0.f);
    grad[i] = sign + sums[0][j] + 2.f * of_x * sums[1][j] + of_y * sums[2][j];
  }
}

dim3 grid(const Photometric& a) {
  return dim3(unsigned((a.width + kTile - 1) / kTile), unsigned((a.height + kTile - 1) / kTile), unsigned(a.planes));
}
float l1_scale(const Photometric& a) {
  return float(a.l1_weight / (double(a.planes) * a.height * a.width));
}

}  // namespace

int64_t photometric_blocks(const Photometric& args) {
  const dim3 blocks = grid(args);
  return int64_t(blocks.x) * blocks.y * blocks.z;
}

void photometric(const Photometric& args, const PhotometricSums& sums, const PhotometricMeans& means,
                 cudaStream_t stream) {
  const int lost = args.valid ? 2 * kRadius : 0;
  const double counted = double(args.planes) * (args.height - lost) * (args.width - lost);
  forward_kernel<<<grid(args), kThreads, 0, stream>>>(args, sums, means, float(args.ssim_weight / counted));
}

void photometric_backward(const Photometric& args, float* grad, cudaStream_t stream) {
  backward_kernel<<<grid(args), kThreads, 0, stream>>>(args, grad, l1_scale(args));
}

}  // namespace splatwizard::cuda
