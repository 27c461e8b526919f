// Context `pyramid` of wisp: networks on running means of the splats before (kernels of sw-wisp and sw-codecs).
#include <new>

#include <exact_kernels/kernels.h>
#include <network.h>

#include "wisp.h"

namespace swz {

namespace {

constexpr int64_t DEEPEST = 15, FEATURES = 69, AT_ONCE = 1 << 14;
constexpr int64_t BASE_WIDTH = 21, VIEW_WIDTH = 25, MEANS = 44;  // of sums with their count, and of means
constexpr int64_t HIDDEN[4] = {32, 48, 32, 40}, STEPS[4] = {1, 2, 1, 1};
constexpr int64_t ADAPTIVE = 1, SMALL = 2;  // flags of the file
constexpr splatwizard::Parallel ALONE;

int64_t outputs_of(int block) { return 2 * BLOCKS[block].width() + STEPS[block]; }

// The largest magnitude of some numbers and `most`.
int64_t largest(const int32_t* numbers, int64_t count, int64_t most) {
  int32_t found = 0;
  for (int64_t i = 0; i < count; ++i) {
    const int32_t size = numbers[i] < 0 ? -numbers[i] : numbers[i];
    found = size > found ? size : found;
  }
  return found > most ? found : most;
}

template <class T>
Buffer<T> zeros(int64_t count) {
  Buffer<T> found(count);
  found.clear();
  return found;
}

// Sums over cells that two splats or more lie in, of one part of the numbers.
struct Sums {
  int64_t width;
  bool known = false;
  Buffer<float> own;     // [splats, width]
  Buffer<double> sums;   // [cells + 1, width]

  const double* at_hand() const { return known ? sums.data : nullptr; }
};

struct Pyramid final : Context {
  const ExactTables& tables;
  bool adaptive;
  double priors[MEANS];          // values and activities of base, then of latents
  const arch_native::Packed* networks[4];
  Buffer<int64_t> ties[4][3];    // [2 c, n] weights with 12 fractional bits
  int64_t sizes[64];             // of a step, by table
  int64_t splats_known = 0, cells = 0, starts[DEEPEST + 2] = {};
  Buffer<int32_t> by_place;
  Buffer<int64_t> fine_codes, leaf, keys, parent, depth;
  Sums base{BASE_WIDTH}, view{VIEW_WIDTH};
  Buffer<bool> needed;
  Buffer<int32_t> means;

  explicit Pyramid(const ExactTables& exact) : tables(exact) {}

  // Takes in splats that are not known yet.
  [[gnu::noinline]] void announce(const Splats& splats) {
    const int64_t before = splats_known, n = splats.count;
    Buffer<int64_t> codes(n);
    for (int64_t i = 0; i < n; ++i) {
      const int64_t up = DEEPEST - splats.levels[i];
      codes[i] = up >= 0 ? splats.codes[i] << 3 * up : splats.codes[i] >> -3 * up;
    }
    fine_codes = static_cast<Buffer<int64_t>&&>(codes);
    const Buffer<int64_t> old = static_cast<Buffer<int64_t>&&>(keys);
    find_cells(splats);
    Buffer<uint8_t> is_new(cells + 1);
    std::memset(is_new.data, 1, static_cast<size_t>(cells + 1));
    Buffer<int64_t> place(old.size);
    for (int64_t i = 0, at = 0; i < old.size; ++i) {
      while (keys[at] != old[i]) ++at;
      place[i] = at;
      is_new[at] = 0;
    }
    for (Sums* part : {&base, &view}) {
      const auto row = static_cast<size_t>(part->width);
      Buffer<double> sums = zeros<double>((cells + 1) * part->width);
      for (int64_t i = 0; i < old.size; ++i)
        std::memcpy(sums.data + part->width * place[i], part->sums.data + part->width * i, sizeof(double) * row);
      part->sums = static_cast<Buffer<double>&&>(sums);
      Buffer<float> own = zeros<float>(n * part->width);
      if (before) std::memcpy(own.data, part->own.data, sizeof(float) * row * static_cast<size_t>(before));
      part->own = static_cast<Buffer<float>&&>(own);
      for (int64_t i = 0; i < before; ++i)  // cells that one splat lay in so far
        for (int64_t at = leaf[i]; is_new[at]; at = parent[at])
          for (int64_t c = 0; c < part->width; ++c)
            part->sums[part->width * at + c] += double{part->own[part->width * i + c]};
    }
    means = Buffer<int32_t>(MEANS * cells);
    needed = Buffer<bool>(cells);
    splats_known = n;
  }

  // All rows by place: those of a subset ascend, as it stands in the file.
  void merge(int64_t count) {
    Buffer<int32_t> merged(count);
    int64_t at = 0, next = splats_known;
    for (int64_t i = 0; i < count; ++i) {
      const bool is_old = at < splats_known && (next == count || fine_codes[by_place[at]] <= fine_codes[next]);
      merged[i] = is_old ? by_place[at++] : static_cast<int32_t>(next++);
    }
    by_place = static_cast<Buffer<int32_t>&&>(merged);
  }

  // Cells of two splats or more, by level and code; their parents; the finest of them around each splat.
  [[gnu::noinline]] void find_cells(const Splats& splats) {
    int64_t left = splats.count;
    merge(left);
    Buffer<int32_t> order(left);
    std::memcpy(order.data, by_place.data, sizeof(int32_t) * static_cast<size_t>(left));
    leaf = zeros<int64_t>(left);
    Buffer<int64_t> found(left + 1), above(left + 1);  // no level has more cells than half of the splats
    int64_t room = left + 1;
    found[0] = 1, above[0] = 0;
    cells = left ? 1 : 0;
    starts[0] = 0, starts[1] = cells;
    for (int64_t level = 1; level <= DEEPEST; ++level) {
      int64_t kept = 0;
      for (int64_t i = 0; i < left; ++i)
        if (splats.levels[order[i]] >= level) order[kept++] = order[i];
      left = kept, kept = 0;
      const int64_t shift = 3 * (DEEPEST - level);
      int64_t up = starts[level - 1];
      for (int64_t i = 0, end; i < left; i = end) {
        const int64_t code = fine_codes[order[i]] >> shift;
        for (end = i + 1; end < left && fine_codes[order[end]] >> shift == code;) ++end;
        if (end - i < 2) continue;
        if (cells == room) {
          const int64_t more = 2 * room;
          for (Buffer<int64_t>* each : {&found, &above}) {
            Buffer<int64_t> larger(more);
            std::memcpy(larger.data, each->data, sizeof(int64_t) * static_cast<size_t>(cells));
            *each = static_cast<Buffer<int64_t>&&>(larger);
          }
          room = more;
        }
        found[cells] = code | int64_t{1} << 3 * level;
        while (found[up] != found[cells] >> 3) ++up;
        above[cells] = up;
        for (int64_t k = i; k < end; ++k) {
          leaf[order[k]] = cells;
          order[kept++] = order[k];
        }
        ++cells;
      }
      left = kept;
      starts[level + 1] = cells;
    }
    keys = Buffer<int64_t>(cells);
    parent = Buffer<int64_t>(cells + 1);
    depth = Buffer<int64_t>(cells);
    const auto bytes = sizeof(int64_t) * static_cast<size_t>(cells);
    std::memcpy(keys.data, found.data, bytes);
    std::memcpy(parent.data, above.data, bytes);
    parent[cells] = cells;
    for (int64_t level = 0; level <= DEEPEST; ++level)
      for (int64_t cell = starts[level]; cell < starts[level + 1]; ++cell) depth[cell] = level;
  }

  pyramid_features_call call_of(const int64_t* rows, int64_t n, const Splats& splats) const {
    pyramid_features_call call{};
    call.rows = rows, call.n = n, call.splats = splats.count, call.cells = cells;
    call.levels = splats.levels.data, call.leaf = leaf.data, call.parent = parent.data, call.depth = depth.data;
    call.starts = starts, call.base_prior = priors, call.view_prior = priors + 2 * BASE.width();
    call.base_sums = base.at_hand(), call.view_sums = view.at_hand();
    call.needed = needed.data;
    return call;
  }

  void add(const int64_t* rows, int64_t n, const int64_t* values, const int64_t* indices, int64_t first,
           int64_t columns, Sums& to) {
    pyramid_add_call call{};
    call.rows = rows, call.n = n, call.splats = splats_known, call.cells = cells;
    call.leaf = leaf.data, call.parent = parent.data, call.values = values, call.indices = indices;
    call.first = first, call.columns = columns, call.width = to.width;
    call.own = to.own.data, call.sums = to.sums.data;
    arch_native::pyramid_add(call, ALONE);
  }

  void look(Rows rows, const Splats& splats) override {
    if (splats_known < splats.count) announce(splats);
    Buffer<int64_t> number(rows.count);
    for (int64_t i = 0; i < rows.count; ++i) number[i] = rows[i];
    arch_native::pyramid_means(call_of(number.data, rows.count, splats), means.data);
  }

  void predict(int block, Rows rows, const Splats& splats, Prediction& to) override {
    const int64_t known = BLOCKS[block].first, width = BLOCKS[block].width();
    const pyramid_features_call call = call_of(nullptr, 0, splats);
    int32_t own[arch_native::BLOCK * NUMBERS];
    const auto inputs = [&](int64_t start, int64_t n, arch_native::Rows& in) {
      int64_t number[arch_native::BLOCK];
      for (int64_t r = 0; r < n; ++r) number[r] = rows[start + r];
      arch_native::pyramid_seen(call, means.data, number, n, in.stride, in.value.data);
      for (int64_t r = 0; r < n; ++r) {
        int32_t* seen = in.value.data + in.stride * r;
        std::memcpy(own + width * r, seen + known, sizeof(int32_t) * static_cast<size_t>(width));
        for (int64_t c = 0; c < known; ++c)
          seen[FEATURES + c] = static_cast<int32_t>(clamped(splats.unit(number[r], c), -VALUE_LIMIT, VALUE_LIMIT));
        in.most = largest(seen, FEATURES + known, in.most);
      }
    };
    const auto outputs = [&](int64_t start, int64_t n, const double* found, int64_t stride) {
      for (int64_t r = 0, at = width * start; r < n; ++r, found += stride)
        for (int64_t c = 0; c < width; ++c, ++at) {
          to.mean[at] = own[width * r + c] + static_cast<int64_t>(found[c]);
          to.scale[at] = static_cast<int64_t>(found[width + c]);
          const auto step = static_cast<int64_t>(found[2 * width + (block == 1 && c == width - 1)]);
          to.multiplier[at] = static_cast<int32_t>(adaptive ? tables.multiplier(step) : UNIT);
        }
    };
    arch_native::over_blocks(*networks[block], rows.count, 0, ALONE, inputs, outputs);
  }

  void tie(int block, int piece, int64_t row, const Splats& splats, int64_t* mean, int64_t* scale) const override {
    if (piece == 0) return;
    const int64_t first = BLOCKS[block].first, n = PIECES[block][piece].first - first, c = PIECES[block][piece].width();
    const int64_t* w = ties[block][piece].data;
    int64_t sums[2 * (LATENTS.end - LATENTS.first)] = {};
    bool any = false;
    for (int64_t i = 0; i < n; ++i) {
      const int64_t at = NUMBERS * row + first + i, k = splats.index[at], size = k < 0 ? -k : k;
      if (k == 0) continue;  // mostly
      any = true;
      const int64_t residual = clamped(k * splats.multiplier[at], -VALUE_LIMIT, VALUE_LIMIT);
      const int64_t large = clamped(size * sizes[table_of(splats.scale[at], 0)], 0, 4 * UNIT);
      for (int64_t j = 0; j < c; ++j) sums[j] += w[n * j + i] * residual, sums[c + j] += w[n * (c + j) + i] * large;
    }
    for (int64_t j = 0; any && j < c; ++j) mean[j] += sums[j] >> 12, scale[j] += sums[c + j] >> 12;
  }

  void learn(Span columns, Rows rows, const Splats& splats) override {
    Sums& to = columns.first == BASE.first ? base : view;
    to.known = true;
    const int64_t most = rows.count < AT_ONCE ? rows.count : AT_ONCE, width = columns.width();
    Buffer<int64_t> number(most), values(width * most), indices(width * most);
    for (int64_t begin = 0; begin < rows.count; begin += most) {
      const Rows some = rows.part(begin, most);
      for (int64_t i = 0; i < some.count; ++i) {
        number[i] = some[i];
        for (int64_t c = 0; c < width; ++c) {
          values[width * i + c] = splats.unit(some[i], columns.first + c);
          indices[width * i + c] = splats.index[NUMBERS * some[i] + columns.first + c];
        }
      }
      add(number.data, some.count, values.data, indices.data, 0, width, to);
    }
  }

  void forget() override {
    base = Sums{BASE_WIDTH}, view = Sums{VIEW_WIDTH};
    for (Buffer<int64_t>* each : {&fine_codes, &leaf, &keys, &parent, &depth}) *each = {};
    by_place = {}, means = {}, needed = {};
  }

  void refine(Rows rows, const int64_t* before, const Splats& splats) override {
    Buffer<int64_t> number(rows.count), changes(REFINED.width() * rows.count);
    for (int64_t i = 0; i < rows.count; ++i) {
      number[i] = rows[i];
      for (int64_t c = 0; c < REFINED.width(); ++c) {
        const int64_t at = REFINED.width() * i + c;
        changes[at] = clamped(splats.unit(rows[i], REFINED.first + c), -VALUE_LIMIT, VALUE_LIMIT) -
                      clamped(before[at], -VALUE_LIMIT, VALUE_LIMIT);
      }
    }
    add(number.data, rows.count, changes.data, nullptr, REFINED.first, REFINED.width(), base);
  }
};

}  // namespace

Context& read_pyramid(Bytes& from, const ExactTables& tables) {
  auto& found = *new Pyramid(tables);
  found.base_parts = 6, found.later_parts = 4;
  const auto flags = static_cast<int64_t>(from.integer(1));
  if (flags > ADAPTIVE + SMALL) refuse("the context has flags ", flags, ", which are not known");
  found.adaptive = flags & ADAPTIVE;
  for (int64_t i = 0; i < MEANS; ++i) found.priors[i] = UNIT / 16;
  for (int64_t i = 0; i < NUMBERS; ++i) {
    const int64_t at = i < BASE.end ? i : i + BASE.width();  // behind the activities of base
    found.priors[at] = 16 * static_cast<int16_t>(from.integer(2));
  }
  int lowest = HIGHEST_EXPONENT;
  Buffer<double> weights[2], biases[2];
  splatwizard::Layer layers[2];
  for (int i = 0; i < 8; ++i) {
    const int block = i / 2;
    const int64_t hidden = HIDDEN[block] / (flags & SMALL ? 2 : 1);
    const int64_t outputs = i % 2 ? outputs_of(block) : hidden;
    const int64_t inputs = i % 2 ? hidden : FEATURES + BLOCKS[block].first;
    EightBitLayer layer;
    layer.read(from, outputs, inputs, true);
    lowest = layer.lowest() < lowest ? layer.lowest() : lowest;
    Buffer<double>&own = weights[i % 2], &bias = biases[i % 2];
    own = Buffer<double>(outputs * inputs), bias = Buffer<double>(outputs);
    for (int64_t row = 0; row < outputs; ++row) {
      bias[row] = layer.bias(row) * (1 << 24);
      for (int64_t c = 0; c < inputs; ++c) own[inputs * row + c] = layer.weight(row, c) * UNIT;
    }
    layers[i % 2] = {own.data, bias.data, inputs, outputs};
    if (i % 2) found.networks[block] = new arch_native::Packed(layers, 2);
  }
  for (int block = 0; block < 4; ++block)
    for (int piece = 1; piece < PIECES_OF[block]; ++piece) {
      const int64_t rows = 2 * PIECES[block][piece].width(), n = PIECES[block][piece].first - BLOCKS[block].first;
      const Bytes exponents = from.take(rows), weights = from.take(rows * n);
      Buffer<int64_t> tie(rows * n);
      bool fits = true, small = true;
      for (int64_t i = 0; i < rows * n; ++i) {
        const auto weight = static_cast<int8_t>(weights.data[i]);
        const auto exponent = static_cast<int8_t>(exponents.data[i / n]);
        fits &= exponent >= EXACT_EXPONENT && exponent <= HIGHEST_EXPONENT;
        small &= weight != INT8_MIN;
        tie[i] = fits ? weight * (int64_t{1} << (exponent - EXACT_EXPONENT)) : 0;
      }
      if (!fits) refuse("an exponent of a tie is out of range");
      if (!small) refuse("a weight of a tie is out of range");
      found.ties[block][piece] = static_cast<Buffer<int64_t>&&>(tie);
    }
  if (lowest < EXACT_EXPONENT) refuse("a weight of the context is finer than its integers");
  for (int t = 0; t < 64; ++t) {
    const double scale = tables.scales[t];
    found.sizes[t] = static_cast<int64_t>(__builtin_rint(UNIT / __builtin_sqrt(scale * scale + 1.0 / 12)));
  }
  return found;
}

}  // namespace swz
