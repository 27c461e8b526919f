#include "face.h"

#include "kernels.h"

using splatwizard::refuse;

SW_OPERATION(splatwizard_gaussians, sparse_adam) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    for (int64_t i = 0; i < call->count; ++i)
      if (call->updates[i].width < 0) refuse("update %lld has rows of %lld numbers", (long long)i,
                                             (long long)call->updates[i].width);
    for (int64_t i = 0; i < call->count; ++i) {
      const sparse_update& u = call->updates[i];
      const splatwizard::SparseAdamArgs args{
          u.param, u.grad, u.exp_avg, u.exp_avg_sq, call->marked, call->rows, u.width, float(u.lr),
          float(1. - u.beta1), float(u.beta2), float(1. - u.beta2), float(u.eps)};
      SW_SELECT(sparse_adam)(args, parallel);
    }
  });
}

SW_OPERATION(splatwizard_gaussians, merge_partners) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    if (call->rows < 0 || call->n < 0 || call->n > UINT32_MAX || call->width < 3 || call->window < 1 || call->window > 64)
      refuse("%lld rows of %lld coefficients, a window of %lld", (long long)call->rows, (long long)call->width,
             (long long)call->window);
    for (int64_t i = 0; i < call->n; ++i)
      if (call->order[i] < 0 || call->order[i] >= call->rows)
        refuse("row %lld of %lld", (long long)call->order[i], (long long)call->rows);
    const splatwizard::MergePartnersArgs args{
        call->table, call->sh, call->weights, call->order, call->n, call->width, call->window,
        uint32_t(call->wave), float(call->near), call->prices, call->best, call->partner};
    SW_SELECT(merge_partners)(args, parallel);
  });
}

SW_OPERATION(splatwizard_gaussians, merge_pairs) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    if (call->rows < 0 || call->n < 0 || call->width < 3)
      refuse("%lld rows of %lld coefficients", (long long)call->rows, (long long)call->width);
    for (int64_t i = 0; i < 2 * call->n; ++i)
      if (call->pairs[i] < 0 || call->pairs[i] >= call->rows)
        refuse("row %lld of %lld", (long long)call->pairs[i], (long long)call->rows);
    const splatwizard::MergePairsArgs args{
        call->means, call->scales, call->quats, call->opacities, call->sh, call->table, call->pairs,
        call->n, call->width, float(call->unit), call->center, call->widen != 0};
    SW_SELECT(merge_pairs)(args, parallel);
  });
}
