// L1 and SSIM of two images and the gradient of their weighted sum with respect to the first, in one pass.
//
// Window w: 11 x 11 Gaussian, sigma 1.5, separable. With u = x + y and v = x - y four blurs give all that SSIM
// needs (five with x, y, x^2, y^2, xy):
//   mu = blur(u)   mv = blur(v)   su = blur(u^2) - mu^2   sv = blur(v^2) - mv^2
//   A = mx^2 + my^2 + C1 = (mu^2 + mv^2)/2 + C1        C = 2 mx my + C1 = (mu^2 - mv^2)/2 + C1
//   B = sx + sy + C2     = (su + sv)/2 + C2            D = 2 sxy + C2   = (su - sv)/2 + C2
//   ssim = C D / (A B)
// and the three partial derivatives are blurred once more (zero padding makes the blur self-adjoint):
//   p1 = 2 my (D - C)/(A B) - 2 mx ssim (1/A - 1/B)    p2 = -ssim/B    p3 = 2 C/(A B)
//   d sum(ssim) / dx = blur(p1) + 2 x blur(p2) + y blur(p3)
//
// Rows stream through two ring buffers of 11 rows: the horizontal sums of u, v, u^2, v^2, and those of p1, p2, p3.
// The image is cut into strips of columns, so that both rings stay in the first-level cache and every row of them
// has a constant stride. A pixel's value depends neither on the strip nor on the rows a thread was given, and row
// sums are added up by one thread: the result is bit-equal for any number of threads.
#include "kernels.h"

namespace SW_ARCH {
namespace {

constexpr int R = 5;              // window radius
constexpr int TAPS = 2 * R + 1;
constexpr int STRIP = 128;        // columns of output at a time, at most
constexpr int P_WIDTH = 144;      // >= STRIP + 2 R: columns where the derivatives are needed, a multiple of 16
constexpr int X_WIDTH = 160;      // >= P_WIDTH + 2 R
constexpr float C1 = 0.01f * 0.01f;
constexpr float C2 = 0.03f * 0.03f;
// exp(-k^2 / (2 * 1.5^2)), k = -5 .. 5, normalised to sum 1.
constexpr float W[TAPS] = {0.0010283801f, 0.007598758f, 0.036000773f, 0.10936069f, 0.21300554f, 0.26601171f,
                           0.21300554f,   0.10936069f,  0.036000773f, 0.007598758f, 0.0010283801f};

struct alignas(64) Workspace {
  float stats[TAPS][4][P_WIDTH];    // ring: horizontal sums of u, v, u^2, v^2
  float derivs[TAPS][3][STRIP];     // ring: horizontal sums of p1, p2, p3
  float zeros[4][P_WIDTH];          // stands for the rows above and below the image
  float line[4][X_WIDTH];           // u, v, u^2, v^2 of one row, with zeros beside the image
  float p[3][X_WIDTH];              // p1, p2, p3 of one row
  float map[P_WIDTH];               // the SSIM of one row
};

// The loops are functions of their own on purpose: inlined into each other GCC 12 runs out of registers for the row
// pointers and gives up on the reductions, silently.
#define SW_LOOP __attribute__((noinline)) void

// out[i] = sum_k W[k] in[i + k]
SW_LOOP blur_line(const float* __restrict in, float* __restrict out, int count) {
  for (int i = 0; i < count; ++i) {
    float sum = W[0] * in[i];
    for (int k = 1; k < TAPS; ++k) sum += W[k] * in[i + k];
    out[i] = sum;
  }
}

// u, v, u^2, v^2 of one row
SW_LOOP mix_row(const float* __restrict x, const float* __restrict y, float* __restrict line, int from, int to) {
  for (int i = from; i < to; ++i) {
    const float u = x[i] + y[i], v = x[i] - y[i];
    line[i] = u;
    line[i + X_WIDTH] = v;
    line[i + 2 * X_WIDTH] = u * u;
    line[i + 3 * X_WIDTH] = v * v;
  }
}

SW_LOOP add_absolute_difference(const float* __restrict x, const float* __restrict y, int count, double& total) {
  float sum = 0.f;
#pragma omp simd reduction(+ : sum)
  for (int i = 0; i < count; ++i) sum += __builtin_fabsf(x[i] - y[i]);
  total += sum;
}

SW_LOOP add_line(const float* __restrict line, int count, double& total) {
  float sum = 0.f;
#pragma omp simd reduction(+ : sum)
  for (int i = 0; i < count; ++i) sum += line[i];
  total += sum;
}

// The vertical blur of column j; t[k] is the row k - R below the middle one.
struct Rows {
  const float* t[TAPS];
};

#define SW_COLUMN(j)                                                                                              \
  (W[0] * (t0[j] + t10[j]) + W[1] * (t1[j] + t9[j]) + W[2] * (t2[j] + t8[j]) + W[3] * (t3[j] + t7[j]) +           \
   W[4] * (t4[j] + t6[j]) + W[5] * t5[j])
#define SW_UNPACK_ROWS(rows)                                                                                      \
  const float *__restrict t0 = rows.t[0], *__restrict t1 = rows.t[1], *__restrict t2 = rows.t[2],                 \
              *__restrict t3 = rows.t[3], *__restrict t4 = rows.t[4], *__restrict t5 = rows.t[5],                 \
              *__restrict t6 = rows.t[6], *__restrict t7 = rows.t[7], *__restrict t8 = rows.t[8],                 \
              *__restrict t9 = rows.t[9], *__restrict t10 = rows.t[10]

// SSIM of one row, and its derivatives p1, p2, p3 (X_WIDTH apart).
template <bool WITH_GRAD>
SW_LOOP map_line(const Rows& rows, float* __restrict map, float* __restrict p, int count) {
  SW_UNPACK_ROWS(rows);
#pragma omp simd
  for (int i = 0; i < count; ++i) {
    const float mu = SW_COLUMN(i), mv = SW_COLUMN(i + P_WIDTH);
    const float mu2 = mu * mu, mv2 = mv * mv;
    const float su = SW_COLUMN(i + 2 * P_WIDTH) - mu2, sv = SW_COLUMN(i + 3 * P_WIDTH) - mv2;
    const float A = 0.5f * (mu2 + mv2) + C1, B = 0.5f * (su + sv) + C2;
    const float C = 0.5f * (mu2 - mv2) + C1, D = 0.5f * (su - sv) + C2;
    const float inv = 1.f / (A * B);
    const float ssim = C * D * inv;
    map[i] = ssim;
    if (WITH_GRAD) {
      const float mx2 = mu + mv, my2 = mu - mv;  // 2 mx, 2 my
      p[i] = inv * (my2 * (D - C) - mx2 * ssim * (B - A));
      p[i + X_WIDTH] = -ssim * A * inv;
      p[i + 2 * X_WIDTH] = 2.f * C * inv;
    }
  }
}

SW_LOOP grad_line(const Rows& rows, const float* __restrict x, const float* __restrict y, float* __restrict out,
                  int count, float l1, float g) {
  SW_UNPACK_ROWS(rows);
#pragma omp simd
  for (int i = 0; i < count; ++i) {
    const float xi = x[i], yi = y[i];
    const float ssim = SW_COLUMN(i) + 2.f * xi * SW_COLUMN(i + STRIP) + yi * SW_COLUMN(i + 2 * STRIP);
    const float sign = (xi > yi ? 1.f : 0.f) - (xi < yi ? 1.f : 0.f);
    out[i] = g * ssim + l1 * sign;
  }
}

struct Strip {
  const splatwizard::PhotometricArgs& args;
  Workspace& ws;
  const float* x;      // this plane
  const float* y;
  float* grad;
  int64_t left;        // first column of the strip
  int count;           // columns of the strip
  int p_count;         // columns of derivatives, rounded up to whole vectors

  // Horizontal sums of row `row` into its slot of the ring. Column j of the sums is image column left - R + j.
  void add_row(int64_t row) {
    const int64_t first = left - 2 * R;
    const int width = p_count + 2 * R;
    const int from = static_cast<int>(first < 0 ? -first : 0);
    const int64_t room = args.width - first;
    const int to = static_cast<int>(room < width ? room : width);
    auto& line = ws.line;
    for (int s = 0; s < 4; ++s) {
      for (int i = 0; i < from; ++i) line[s][i] = 0.f;
      for (int i = to; i < width; ++i) line[s][i] = 0.f;
    }
    const int64_t offset = row * args.width + first;
    mix_row(x + offset, y + offset, &line[0][0], from, to);
    for (int s = 0; s < 4; ++s) blur_line(line[s], ws.stats[row % TAPS][s], p_count);
  }

  // The rows of a ring around `row`; zeros above and below the image.
  template <int SLOT>
  Rows around(const float* ring, int64_t row) const {
    Rows rows;
    for (int k = 0; k < TAPS; ++k) {
      const int64_t r = row - R + k;
      rows.t[k] = r >= 0 && r < args.height ? ring + (r % TAPS) * SLOT : &ws.zeros[0][0];
    }
    return rows;
  }

  // SSIM of row `row` into ws.map, its derivatives into ws.p: columns left - R .. left - R + p_count - 1.
  void map_row(int64_t row) {
    const Rows rows = around<4 * P_WIDTH>(&ws.stats[0][0][0], row);
    if (grad != nullptr) {
      map_line<true>(rows, ws.map, &ws.p[0][0], p_count);
    } else {
      map_line<false>(rows, ws.map, &ws.p[0][0], p_count);
    }
  }

  // Columns [from, to) of the derivatives' row where the SSIM map exists.
  void inside(int64_t row, int& from, int& to) const {
    const int64_t border = args.valid ? R : 0;
    const int64_t first = left - R;
    if (row < border || row >= args.height - border) {
      from = to = 0;
      return;
    }
    const int64_t a = border - first, b = args.width - border - first;
    from = static_cast<int>(a > 0 ? a : 0);
    to = static_cast<int>(b < p_count ? b : p_count);
    if (to < from) to = from;
  }

  // The derivatives do not exist outside the map; there the blur of the backward pass sees zero.
  void add_derivatives(int64_t row) {
    int from, to;
    inside(row, from, to);
    for (auto& line : ws.p) {
      for (int i = 0; i < from; ++i) line[i] = 0.f;
      for (int i = to; i < p_count; ++i) line[i] = 0.f;
    }
    const int whole = (count + 15) / 16 * 16;
    for (int s = 0; s < 3; ++s) blur_line(ws.p[s], ws.derivs[row % TAPS][s], whole);
  }

  void sum_row(int64_t row, double& l1_sum, double& ssim_sum) const {
    const int64_t offset = row * args.width + left;
    add_absolute_difference(x + offset, y + offset, count, l1_sum);
    int from, to;
    inside(row, from, to);
    from = from < R ? R : from;
    to = to > R + count ? R + count : to;
    add_line(ws.map + from, to - from, ssim_sum);
  }

  void grad_row(int64_t row) const {
    const int64_t offset = row * args.width + left;
    grad_line(around<3 * STRIP>(&ws.derivs[0][0][0], row), x + offset, y + offset, grad + offset, count,
              args.l1_weight, args.ssim_weight);
  }

  // Rows [begin, end) of the plane: sums, and the gradient if it is wanted.
  void run(int64_t begin, int64_t end, double* row_l1, double* row_ssim) {
    const bool with_grad = grad != nullptr;
    const int64_t reach = with_grad ? R : 0;
    auto clip = [&](int64_t r) { return r < 0 ? 0 : r > args.height ? args.height : r; };
    const int64_t first = clip(begin - reach), last = clip(end + reach);
    int64_t next = clip(first - R);       // next row whose horizontal sums are missing
    int64_t next_out = begin;
    for (int64_t row = first; row < last; ++row) {
      for (; next < clip(row + R + 1); ++next) add_row(next);
      map_row(row);
      if (row >= begin && row < end) sum_row(row, row_l1[row], row_ssim[row]);
      if (with_grad) {
        add_derivatives(row);
        // A row of the gradient is complete once the derivatives R rows below it are there.
        for (; next_out < end && (next_out + R <= row || row == args.height - 1); ++next_out) grad_row(next_out);
      }
    }
  }
};

}  // namespace

void photometric(const splatwizard::PhotometricArgs& args, const splatwizard::Parallel& parallel) {
  const int64_t rows = args.planes * args.height;
  const int64_t strips = (args.width + STRIP - 1) / STRIP;
  const int64_t width = ((args.width + strips - 1) / strips + 15) / 16 * 16;  // whole vectors
  // 32 rows: below that the 20 rows of overlap with the neighbours cost more than another thread brings.
  parallel(rows, 32, [&](int64_t begin, int64_t end) {
    Workspace ws{};
    while (begin < end) {
      const int64_t plane = begin / args.height;
      const int64_t from = begin - plane * args.height;
      const int64_t to = end - plane * args.height < args.height ? end - plane * args.height : args.height;
      const int64_t offset = plane * args.height * args.width;
      double* row_l1 = args.row_l1 + plane * args.height;
      double* row_ssim = args.row_ssim + plane * args.height;
      for (int64_t row = from; row < to; ++row) row_l1[row] = row_ssim[row] = 0.;
      for (int64_t left = 0; left < args.width; left += width) {
        const int count = static_cast<int>(args.width - left < width ? args.width - left : width);
        const int p_count = (count + 2 * R + 15) / 16 * 16;
        float* grad = args.grad == nullptr ? nullptr : args.grad + offset;
        Strip strip{args, ws, args.x + offset, args.y + offset, grad, left, count, p_count};
        strip.run(from, to, row_l1, row_ssim);
      }
      begin = plane * args.height + to;
    }
  });
}

}  // namespace SW_ARCH
