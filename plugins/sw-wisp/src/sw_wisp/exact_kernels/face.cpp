// Behind the face: shapes and ranges of rows, and the kernels of this CPU.
#include "face.h"

#include "kernels.h"

namespace {

using namespace splatwizard;

// Rows, the cells around splats, and their parents must lie within what there is; a parent stands before its child.
template <class Call>
void check(const Call* call) {
  for (int64_t i = 0; i < call->n; ++i) {
    const int64_t row = call->rows[i];
    if (row < 0 || row >= call->splats) refuse("row %lld is none of %lld", (long long)row, (long long)call->splats);
    if (call->leaf[row] < 0 || call->leaf[row] >= call->cells) refuse("row %lld has no cell", (long long)row);
  }
  for (int64_t cell = 1; cell < call->cells; ++cell)
    if (call->parent[cell] < 0 || call->parent[cell] >= cell) refuse("cell %lld has no parent", (long long)cell);
}

}  // namespace

SW_OPERATION(sw_wisp_exact, pyramid_features) {
  return guarded(call, [&](const Parallel& parallel) {
    check(call);
    if (call->starts[0] != 0 || call->starts[16] != call->cells) refuse("levels do not hold all cells");
    for (int level = 0; level < 16; ++level)
      if (call->starts[level] > call->starts[level + 1] || (level == 0 && call->starts[1] > 1))
        refuse("cells of level %d are out of order", level);
    SW_SELECT(pyramid_features)(*call, parallel);
  });
}

SW_OPERATION(sw_wisp_exact, pyramid_add) {
  return guarded(call, [&](const Parallel& parallel) {
    check(call);
    const int64_t added = call->indices != nullptr ? 2 * call->columns + 1 : call->columns;
    if (call->first < 0 || call->columns < 0 || added > 32 || call->first + added > call->width)
      refuse("columns %lld .. %lld of %lld", (long long)call->first, (long long)(call->first + added),
             (long long)call->width);
    SW_SELECT(pyramid_add)(*call, parallel);
  });
}
