// The pinhole camera as the kernels see it: world to camera t = R mu + tau, OpenCV axes, pixel centres at +0.5.
#pragma once

#include "common.h"

namespace sw {

template <class S>
struct View {
  int width, height;
  S rotation[9];     // row-major, world -> camera
  S translation[3];  // world units
  S center[3];       // camera centre in the world, -R^T tau
  S fx, fy, cx, cy;  // pixels
  S near, far;       // world units, z range (near excluded)
  S x_low, x_high;   // limits of tx/tz inside the Jacobian
  S y_low, y_high;

  // `values`: R (9), tau (3), fx, fy, cx, cy, near, far.
  static View from(const double* values, int width, int height) {
    View view;
    view.width = width;
    view.height = height;
    for (int i = 0; i < 9; ++i) view.rotation[i] = S(values[i]);
    for (int i = 0; i < 3; ++i) view.translation[i] = S(values[9 + i]);
    for (int i = 0; i < 3; ++i)
      view.center[i] = S(-(values[i] * values[9] + values[3 + i] * values[10] + values[6 + i] * values[11]));
    const double fx = values[12], fy = values[13], cx = values[14], cy = values[15];
    view.fx = S(fx), view.fy = S(fy), view.cx = S(cx), view.cy = S(cy);
    view.near = S(values[16]), view.far = S(values[17]);
    // For a centred principal point these are +-1.3 tan(fov/2).
    const double slack_x = kJacobianClamp * width / (2 * fx), slack_y = kJacobianClamp * height / (2 * fy);
    view.x_low = S(-cx / fx - slack_x), view.x_high = S((width - cx) / fx + slack_x);
    view.y_low = S(-cy / fy - slack_y), view.y_high = S((height - cy) / fy + slack_y);
    return view;
  }

  SW_HD int tiles_x() const { return (width + kTile - 1) / kTile; }
  SW_HD int tiles_y() const { return (height + kTile - 1) / kTile; }
};

}  // namespace sw
