#include "face.h"

#include <cmath>

#include "kernels.h"

using splatwizard::refuse;

SW_OPERATION(splatwizard_training, photometric) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    const int64_t rows = call->planes * call->height, lost = call->valid ? 10 : 0;
    if (call->planes < 1 || call->height <= lost || call->width <= lost)
      refuse("the image of %lld x %lld is too small", (long long)call->height, (long long)call->width);
    const double pixels = double(rows * call->width);
    const double mapped = double(call->planes) * double(call->height - lost) * double(call->width - lost);
    const splatwizard::PhotometricArgs args{
        call->x, call->y, call->planes, call->height, call->width, call->valid != 0, float(call->l1_weight / pixels),
        float(call->ssim_weight / mapped), call->grad, call->row_sums, call->row_sums + rows};
    SW_SELECT(photometric)(args, parallel);
    double l1 = 0., ssim = 0.;
    for (int64_t row = 0; row < rows; ++row) {
      l1 += args.row_l1[row];
      ssim += args.row_ssim[row];
    }
    call->l1 = l1 / pixels;
    call->ssim = ssim / mapped;
  });
}

SW_OPERATION(splatwizard_training, adam) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    for (int64_t i = 0; i < call->count; ++i) {
      const adam_update& u = call->updates[i];
      if (u.step < 1 || u.count < 0) refuse("update %lld has step %lld of %lld numbers", (long long)i,
                                            (long long)u.step, (long long)u.count);
      const double t = double(u.step);
      const splatwizard::AdamArgs args{u.param, u.grad, u.exp_avg, u.exp_avg_sq, u.count,
                                       float(u.lr / (1. - std::pow(u.beta1, t))), float(1. - u.beta1), float(u.beta2),
                                       float(1. - u.beta2), float(1. / std::sqrt(1. - std::pow(u.beta2, t))),
                                       float(u.eps)};
      SW_SELECT(adam)(args, parallel);
    }
  });
}
