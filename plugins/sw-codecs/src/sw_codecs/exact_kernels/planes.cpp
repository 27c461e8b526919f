// Integer planes under spatial models: each value after the twelve neighbours that its distribution hangs on.
//
// Channels do not depend on one another, so eight of them are taken side by side, and streams run in parallel.
#include <atomic>

#include "kernels.h"
#include "rans.h"
#include "vectors.h"

namespace SW_ARCH {

using namespace splatwizard;

namespace {

constexpr int SIDE = 8, VECTORS = SIDE / LANES;  // channels side by side
constexpr int NEIGHBORS = 12, HIDDEN = 16, RESIDUALS = 3;
constexpr int DOWN[NEIGHBORS] = {-2, -2, -2, -2, -2, -1, -1, -1, -1, -1, 0, 0};
constexpr int RIGHT[NEIGHBORS] = {-2, -1, 0, 1, 2, -2, -1, 0, 1, 2, -2, -1};
constexpr int64_t MODEL_NUMBERS = HIDDEN * (NEIGHBORS + 1) + RESIDUALS * HIDDEN * (HIDDEN + 1) + 2 * (HIDDEN + 1);
constexpr int64_t SLOPE = 288539, OFFSET = 7215259165;  // sw_cat_3dgs.spatial_ar
constexpr int64_t PLANE_LIMIT = 1 << 24;
constexpr int TOGETHER = LANES == 8 ? 8 : 4;  // outputs whose sums are kept in registers

using Group = Vec[VECTORS];

template <int IN, int OUT>
const double* layer(const double* weights, const Group* in, Group* out, bool last) {
  const double* bias = weights + IN * OUT;
  constexpr int STEP = OUT < TOGETHER ? OUT : TOGETHER;
  for (int o = 0; o < OUT; o += STEP) {
    Group sum[STEP];
#pragma GCC unroll 8
    for (int j = 0; j < STEP; ++j)
#pragma GCC unroll 8
      for (int v = 0; v < VECTORS; ++v) sum[j][v] = all(bias[o + j]);
    for (int i = 0; i < IN; ++i)
#pragma GCC unroll 8
      for (int j = 0; j < STEP; ++j) {
        const Vec w = all(weights[(o + j) * IN + i]);
#pragma GCC unroll 8
        for (int v = 0; v < VECTORS; ++v) sum[j][v] += w * in[i][v];
      }
#pragma GCC unroll 8
    for (int j = 0; j < STEP; ++j)
#pragma GCC unroll 8
      for (int v = 0; v < VECTORS; ++v) {
        const Vec x = shifted(sum[j][v]);
        out[o + j][v] = last ? x : clamped(x, 0, ACTIVATION_LIMIT);
      }
  }
  return bias + OUT;
}

// Planes of the channels of a bundle, channels innermost, within a border of zeros; integers times 4096 as float32.
// Cells are not padded: of few channels that would be many times the planes. Lanes beyond the channels read what
// follows, and nobody reads those.
struct Field {
  int64_t height, width, channels, lanes, stride;
  Scratch<float> cells;
  int64_t around[NEIGHBORS];

  Field(int64_t h, int64_t w, int64_t c)
      : height(h), width(w), channels(c), lanes((c + SIDE - 1) / SIDE * SIDE), stride((w + 4) * c),
        cells((h + 2) * stride + SIDE) {
    for (int64_t i = 0; i < (h + 2) * stride + SIDE; ++i) cells[i] = 0;
    for (int n = 0; n < NEIGHBORS; ++n) around[n] = DOWN[n] * stride + RIGHT[n] * channels;
  }
  float* at(int64_t row, int64_t column) const { return cells.data + (row + 2) * stride + (column + 2) * channels; }
  static float context(int64_t value) {
    return static_cast<float>((value < -256 ? -256 : value > 256 ? 256 : value) * 4096);
  }
  int64_t steps() const { return height > 0 && width > 0 ? width + 3 * (height - 1) : 0; }
  int64_t first_row(int64_t step) const { return step < width ? 0 : (step - width + 3) / 3; }
  int64_t last_row(int64_t step) const { return step / 3 < height ? step / 3 : height - 1; }
};

// Integer parts of the means and numbers of the tables of all channels at a place.
void predict(const double* weights, const Field& field, const float* cell, int32_t* centre, int16_t* number) {
  for (int64_t lane = 0; lane < field.lanes; lane += SIDE) {
    Group neighbors[NEIGHBORS], a[HIDDEN], b[HIDDEN], ends[2];
    for (int n = 0; n < NEIGHBORS; ++n) {
      const float* p = cell + field.around[n] + lane;
      for (int v = 0; v < VECTORS; ++v)
        neighbors[n][v] = __builtin_convertvector(*reinterpret_cast<const FloatLoad*>(p + v * LANES), Vec);
    }
    const double* w = layer<NEIGHBORS, HIDDEN>(weights, neighbors, a, false);
    w = layer<HIDDEN, HIDDEN>(w, a, b, false);
    w = layer<HIDDEN, HIDDEN>(w, b, a, false);
    w = layer<HIDDEN, HIDDEN>(w, a, b, false);
    layer<HIDDEN, 2>(w, b, ends, true);
    int64_t mean[SIDE], s[SIDE];
    for (int v = 0; v < VECTORS; ++v) {
      store_integers(mean + v * LANES, ends[0][v]);
      store_integers(s + v * LANES, ends[1][v]);
    }
    for (int l = 0; l < SIDE; ++l) {
      int64_t level = (OFFSET - SLOPE * s[l]) >> 28;
      level = level < 0 ? 0 : level > 63 ? 63 : level;
      const int64_t eighths = (8 * mean[l] + 2048) >> 12, c = (eighths + 4) >> 3;
      centre[lane + l] = static_cast<int32_t>(c < -SYMBOL_LIMIT ? -SYMBOL_LIMIT : c > SYMBOL_LIMIT ? SYMBOL_LIMIT : c);
      number[lane + l] = static_cast<int16_t>(8 * level + eighths + 4 - 8 * c);
    }
  }
}

// The streams of a bundle and the channel of each lane.
struct Bundle {
  const PlaneStream* streams;
  int64_t count, channels = 0, scale, orientation;
  int32_t* plane;      // of its orientation [C, H, W]
  int64_t plane_size;  // H W

  Bundle(const PlanesArgs& a, int64_t index)
      : streams(a.streams + a.bundle[index]), count(a.bundle[index + 1] - a.bundle[index]) {
    scale = streams[0].scale;
    orientation = streams[0].orientation;
    for (int64_t s = 0; s < count; ++s) channels += streams[s].channels;
    plane_size = a.height[scale] * a.width[scale];
    plane = a.planes[scale] + (orientation * a.channels[scale] + streams[0].channel) * plane_size;
  }
};

template <class Run>
int32_t over_bundles(const PlanesArgs& a, const Parallel& parallel, Run run) {
  const int64_t bundles = a.bundles_end - a.bundle - 1;
  std::atomic<int64_t> next{0};
  std::atomic<int32_t> status{FINE};
  parallel(parallel.threads < bundles ? parallel.threads : bundles, 1, [&](int64_t, int64_t) {
    // The last bundles are those of the finest planes.
    for (int64_t i; (i = next.fetch_add(1)) < bundles;) {
      const int32_t found = run(bundles - 1 - i);
      int32_t fine = FINE;
      if (found != FINE) status.compare_exchange_strong(fine, found);
    }
  });
  return status;
}

struct Coding {
  WordReader words;
  EscapeReader escapes;
};

int32_t decode_bundle(const Tables& tables, const Streams& streams, const PlanesArgs& a, int64_t index) {
  const Bundle bundle(a, index);
  const Field field(a.height[bundle.scale], a.width[bundle.scale], bundle.channels);
  const double* weights = a.weights + bundle.orientation * MODEL_NUMBERS;
  Scratch<int32_t> centre(field.lanes);
  Scratch<int16_t> number(field.lanes);
  Scratch<Coding> coding(bundle.count);
  for (int64_t s = 0; s < bundle.count; ++s) {
    const int64_t which = a.bundle[index] + s;
    const uint8_t* data = streams.data + streams.offset[which];
    const int64_t *sizes = streams.table + 3 * which;
    coding[s] = Coding{WordReader(data, sizes[1]), EscapeReader(data + sizes[1], sizes[2])};
  }
  for (int64_t step = 0; step < field.steps(); ++step)
    for (int64_t row = field.first_row(step); row <= field.last_row(step); ++row) {
      const int64_t column = step - 3 * row;
      float* cell = field.at(row, column);
      predict(weights, field, cell, centre.data, number.data);
      int32_t* out = bundle.plane + row * field.width + column;
      int64_t lane = 0;
      for (int64_t s = 0; s < bundle.count; ++s) {
        Coding& c = coding[s];
        for (int64_t end = lane + bundle.streams[s].channels; lane < end; ++lane) {
          const int64_t table = number[lane];
          const int32_t radius = tables.radius[table];
          const int32_t entry = c.words.entry(tables.shares + tables.first[table], tables.bucket + 256 * table);
          int64_t value = entry - radius;
          if (__builtin_expect(entry > 2 * radius, 0)) {
            value = c.escapes.beyond(radius);
            if (c.escapes.damaged) return ESCAPES_WRONG;
          }
          value += centre[lane];
          if (value >= PLANE_LIMIT || value <= -PLANE_LIMIT) return BEYOND_LIMIT;
          out[lane * bundle.plane_size] = static_cast<int32_t>(value);
          cell[lane] = Field::context(value);
        }
      }
    }
  for (int64_t s = 0; s < bundle.count; ++s) {
    if (!coding[s].words.used_up()) return WORDS_LEFT;
    if (!coding[s].escapes.used_up()) return ESCAPES_WRONG;
  }
  return FINE;
}

void encode_bundle(const Tables& tables, const Sinks& sinks, const PlanesArgs& a, int64_t index) {
  const Bundle bundle(a, index);
  const Field field(a.height[bundle.scale], a.width[bundle.scale], bundle.channels);
  const double* weights = a.weights + bundle.orientation * MODEL_NUMBERS;
  const int64_t lanes = field.lanes, places = bundle.plane_size;
  Scratch<int32_t> centre(places * lanes), offset(places);
  Scratch<int16_t> number(places * lanes);
  for (int64_t row = 0; row < field.height; ++row)
    for (int64_t column = 0; column < field.width; ++column)
      for (int64_t lane = 0; lane < bundle.channels; ++lane)
        field.at(row, column)[lane] =
            Field::context(bundle.plane[lane * bundle.plane_size + row * field.width + column]);
  int64_t at = 0;
  for (int64_t step = 0; step < field.steps(); ++step)
    for (int64_t row = field.first_row(step); row <= field.last_row(step); ++row, ++at) {
      const int64_t column = step - 3 * row;
      predict(weights, field, field.at(row, column), centre.data + at * lanes, number.data + at * lanes);
      offset[at] = static_cast<int32_t>(row * field.width + column);
    }
  int64_t first = 0;
  for (int64_t s = 0; s < bundle.count; ++s) {
    const int64_t which = a.bundle[index] + s, end = first + bundle.streams[s].channels;
    const auto off_centre = [&](int64_t place, int64_t lane) {
      return int64_t{bundle.plane[lane * bundle.plane_size + offset[place]]} - centre[place * lanes + lane];
    };
    uint8_t* data = sinks.data + sinks.offset[which];
    WordWriter words(data);
    for (int64_t place = places - 1; place >= 0; --place)
      for (int64_t lane = end - 1; lane >= first; --lane) {
        const int64_t table = number[place * lanes + lane], radius = tables.radius[table];
        const int64_t d = off_centre(place, lane);
        const bool inside = d <= radius && d >= -radius;
        words.put(tables.shares + tables.first[table], static_cast<int32_t>(inside ? d + radius : 2 * radius + 1));
      }
    words.finish();
    EscapeWriter escapes(data + words.bytes);
    for (int64_t place = 0; place < places; ++place)
      for (int64_t lane = first; lane < end; ++lane) {
        const int64_t radius = tables.radius[number[place * lanes + lane]], d = off_centre(place, lane);
        if (d > radius || d < -radius) escapes.beyond(d, radius);
      }
    sinks.table[3 * which + 1] = words.bytes;
    sinks.table[3 * which + 2] = escapes.bytes();
    first = end;
  }
}

}  // namespace

int32_t decode_planes(const Tables& tables, const Streams& streams, const PlanesArgs& a, const Parallel& parallel) {
  return over_bundles(a, parallel, [&](int64_t i) { return decode_bundle(tables, streams, a, i); });
}

int32_t encode_planes(const Tables& tables, const Sinks& sinks, const PlanesArgs& a, const Parallel& parallel) {
  return over_bundles(a, parallel, [&](int64_t i) {
    encode_bundle(tables, sinks, a, i);
    return static_cast<int32_t>(FINE);
  });
}

}  // namespace SW_ARCH
