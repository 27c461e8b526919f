// Behind the face: numbers under mixtures of two tables.
#include "face.h"
#include "mixtures.h"

namespace {

using namespace splatwizard;

template <class Call>
MixtureArgs mixtures_of(const Call* call) {
  const int32_t *order = call->order, *width = call->half_width;
  const int16_t* number = call->number;
  const int64_t n = call->count;
  for (int64_t i = 0; i < n; ++i)
    if (order[i] < 0 || order[i] >= n || width[i] < 1 || width[i] > 1 << 16 || number[2 * i] < 0 ||
        number[2 * i] >= 512 || number[2 * i + 1] < 0 || number[2 * i + 1] >= 512)
      refuse("row %lld is out of range", (long long)i);
  return {call->below, call->escape, call->first, call->radius, order, width, call->shift, number, call->weight, n};
}

}  // namespace

SW_OPERATION(sw_codecs_exact, decode_mixtures) {
  return guarded(call, [&](const Parallel&) {
    call->status = SW_SELECT(decode_mixtures)(mixtures_of(call), call->words, call->bytes, call->entries);
  });
}

SW_OPERATION(sw_codecs_exact, encode_mixtures) {
  return guarded(call, [&](const Parallel&) {
    const MixtureArgs args = mixtures_of(call);
    if (call->room < 4 * (args.n + 2)) refuse("words need more room");
    for (int64_t i = 0; i < args.n; ++i)
      if (call->entries[i] < 0 || call->entries[i] > 2 * args.width[i] + 1)
        refuse("entry %lld is out of range", (long long)i);
    call->written = SW_SELECT(encode_mixtures)(args, call->entries, call->words);
  });
}

SW_OPERATION(sw_codecs_exact, mixture_rows) {
  return guarded(call, [&](const Parallel& parallel) {
    if (call->rows < 0 || call->columns < 0 || call->rows * call->columns >= int64_t{1} << 31 || call->widths < 1 ||
        call->widths > 256)
      refuse("shapes do not fit");
    MixtureRowsArgs args{};
    for (int g = 0; g < 2; ++g) {
      args.mean[g] = call->parts[2 * g];
      args.scale[g] = call->parts[2 * g + 1];
    }
    args.logit = call->parts[4];
    args.step = call->step;
    for (int i = 0; i < 5; ++i) args.stride[i] = call->strides[i];
    args.stride[5] = call->step_stride;
    args.rows = call->rows;
    args.columns = call->columns;
    args.multipliers = call->multipliers;
    args.thresholds = call->thresholds;
    args.radius = call->radius;
    args.half_widths = call->half_widths;
    args.widths = call->widths;
    args.centre = call->centre;
    args.width = call->width;
    args.order = call->order;
    args.shift = call->shift;
    args.number = call->number;
    args.weight = call->weight;
    call->status = SW_SELECT(mixture_rows)(args, parallel);
  });
}
