// Tile coverage against brute force, compiled by test_tiles.py, on random ellipses. A tile is missed if one of its
// pixel centres lies inside the ellipse but it is not listed (once); it is in excess if it is listed although the
// ellipse does not even meet the rectangle spanned by its pixel centres. Prints: cases, missed, excess, tiles that meet
// the ellipse.
#include <cmath>
#include <cstdio>
#include <limits>
#include <random>
#include <vector>

#include "tiles.h"

// Smallest value of ka x^2 + 2 kb x y + kc y^2 over the box, by the facing edges.
static double box_minimum(double ka, double kb, double kc, double x0, double x1, double y0, double y1) {
  const auto clamp = [](double v, double low, double high) { return v < low ? low : v > high ? high : v; };
  const auto form = [&](double x, double y) { return ka * x * x + 2 * kb * x * y + kc * y * y; };
  const double x = clamp(0, x0, x1), y = clamp(0, y0, y1);
  const double a = form(x, clamp(-kb / kc * x, y0, y1)), b = form(clamp(-kb / ka * y, x0, x1), y);
  return a < b ? a : b;
}

static bool has_pixel_inside(double ka, double kb, double kc, double t, double u, double v, int x0, int y0, int width,
                             int height) {
  for (int y = y0; y < y0 + 16 && y < height; ++y)
    for (int x = x0; x < x0 + 16 && x < width; ++x) {
      const double dx = x + 0.5 - u, dy = y + 0.5 - v;
      if (ka * dx * dx + 2 * kb * dx * dy + kc * dy * dy <= t) return true;
    }
  return false;
}

int main() {
  std::mt19937_64 generator(7);
  std::uniform_real_distribution<double> uniform(0, 1);
  const int width = 150, height = 110, columns = 10, rows = 7;
  long cases = 0, missed = 0, excess = 0, total = 0;
  for (; cases < 10000; ++cases) {
    // Axes from 0.5 to 60 px, condition of the covariance up to 1e4, any orientation, centre also outside.
    const double major = 0.5 * std::pow(120, uniform(generator)), minor = major * std::pow(0.01, uniform(generator));
    const double angle = 3.14159265358979 * uniform(generator), c = std::cos(angle), s = std::sin(angle);
    const double c00 = major * major * c * c + minor * minor * s * s,
                 c11 = major * major * s * s + minor * minor * c * c;
    const double c01 = (major * major - minor * minor) * c * s, det = major * major * minor * minor;
    const double ka = c11 / det, kb = -c01 / det, kc = c00 / det, t = 0.1 + 11 * uniform(generator);
    const double u = -40 + (width + 80) * uniform(generator), v = -40 + (height + 80) * uniform(generator);
    const double hx = std::sqrt(t * c00), hy = std::sqrt(t * c11);
    const sw::Ellipse<double> ellipse{u, v, hx, hy, std::sqrt(t / ka), -kb / ka, -kb / kc * hx};
    std::vector<int> found(columns * rows, 0);
    const int count = sw::tight_tiles(ellipse, width, height, [&](int x, int y) { ++found[y * columns + x]; });
    long listed = 0;
    for (int y = 0; y < rows; ++y)
      for (int x = 0; x < columns; ++x) {
        const double x1 = std::fmin(16 * x + 15.5, width - 0.5), y1 = std::fmin(16 * y + 15.5, height - 0.5);
        const double lowest = box_minimum(ka, kb, kc, 16 * x + 0.5 - u, x1 - u, 16 * y + 0.5 - v, y1 - v);
        const int times = found[y * columns + x];
        listed += times;
        if (times != 1 && lowest <= t) missed += has_pixel_inside(ka, kb, kc, t, u, v, 16 * x, 16 * y, width, height);
        excess += lowest > t * (1 + 1e-9) && times != 0;
        total += lowest <= t;
      }
    if (listed != count) ++missed;
  }
  // A needle so long that its extent overflows, the edge of a pixel row on its upper or lower end.
  for (int i = 0; i < 1000; ++i) {
    const float inf = std::numeric_limits<float>::infinity(), hy = 0.5f + 30 * float(uniform(generator));
    const float v = float(int(100 * uniform(generator))) + 0.5f + (i % 2 ? hy : -hy);
    const sw::Ellipse<float> ellipse{8, v, inf, hy, inf, 0, std::nanf("")};
    bool inside = true;
    const int count = sw::tight_tiles(
        ellipse, width, height, [&](int x, int y) { inside &= x >= 0 && x < columns && y >= 0 && y < rows; });
    if (!inside || count % columns != 0) ++missed;
  }
  std::printf("%ld %ld %ld %ld\n", cases, missed, excess, total);
}
