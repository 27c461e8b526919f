// Codec `gaussians-tiles`: all coarsely, then place by place, then as exactly as it is (docs/bitstream.md, Gaussians by a codec).
#include "gaussian_files.h"
#include "quantized.h"

namespace swz {

namespace {

constexpr int64_t MOST_GROUPS = 255;

// Of a packet behind the first: Gaussians of a tile that stay, then stand-ins until the tile's next group.
struct Group {
  int64_t tile, rows, stand_ins, packet;
};

// A list of header values, each an integer, or `width` of them in a row.
template <class Take>
int64_t integers_of(const Container& file, const char* key, int width, const Take& take) {
  const Json* list = stated(file, key);
  if (list->kind != Json::ARRAY) wrong(key, "Input should be a valid list");
  if (list->length > MOST_GROUPS)
    refuse("header value '", key, "': List should have at most ", MOST_GROUPS, " items after validation, not ",
           static_cast<int64_t>(list->length));
  int64_t number = 0;
  for (const Json* each = list->first; each != nullptr; each = each->next, ++number) {
    int64_t values[3] = {};
    bool fits = width == 1 || (each->kind == Json::ARRAY && each->length == width);
    const Json* value = width == 1 ? each : each->first;
    for (int i = 0; fits && i < width; ++i, value = value->next) {
      fits = value->kind == Json::INTEGER && value->integer >= 0 && value->integer <= UINT32_MAX;
      values[i] = value->integer;
    }
    if (!fits) wrong(key, "Input should be rows of valid integers");
    take(number, values);
  }
  return number;
}

struct Plan {
  int64_t first, tiles, groups;
  int64_t base[MOST_GROUPS];  // stand-ins of packet 1 in each tile
  Group group[MOST_GROUPS];
  int64_t last[MOST_GROUPS];  // the group of a tile whose stand-ins are shown; -1: those of packet 1
  int64_t times = 1, raw = 0;
  int64_t finer[MOST_GROUPS + 2];  // of a packet the one that makes its rows finer, or 0 where none is there

  // Refuses cuts, tiles and groups that make no scene.
  Plan(const Container& file, const Layout& layout) {
    for (const char* key : {"packets", "precision", "sh_basis"})
      if (file.value(key) != nullptr && file.value(key)->kind != Json::NOTHING) wrong(key, "Input should be None");
    first = stated_integer(file, "first", 0, UINT32_MAX);
    tiles = integers_of(file, "base", 1, [&](int64_t i, const int64_t* value) { base[i] = *value; });
    groups = integers_of(file, "groups", 3, [&](int64_t i, const int64_t* values) {
      group[i] = {values[0], values[1], values[2], 0};
    });
    bool is_finer[MOST_GROUPS + 2] = {};
    int64_t pairs = 0;
    bool sound = true;
    for (int64_t& packet : finer) packet = 0;
    if (file.value("times") != nullptr) times = stated_integer(file, "times", 1, 255);
    if (file.value("raw") != nullptr) raw = stated_integer(file, "raw", 0, 12);
    if (file.value("finer") != nullptr)
      pairs = integers_of(file, "finer", 2, [&](int64_t, const int64_t* values) {
        const int64_t packet = values[0], source = values[1];
        sound &= packet >= 2 && packet <= MOST_GROUPS + 1 && source >= 1 && source < packet;
        if (!sound) return;
        sound &= !is_finer[packet] && finer[source] == 0;
        is_finer[packet] = true, finer[source] = packet;
      });
    const int64_t packets = groups + pairs + 1;
    for (int64_t packet = 1; packet < MOST_GROUPS + 2; ++packet)
      sound &= (!is_finer[packet] || packet <= packets) && (finer[packet] == 0 || !is_finer[packet]);
    int64_t of_last[MOST_GROUPS], sum = first;  // stand-ins of the last group of each tile
    for (int64_t t = 0; t < tiles; ++t) of_last[t] = -1, last[t] = -1;
    bool fits = sound && file.cuts == packets && layout.scales == 3 && times % 2 == 1 && raw < layout.bits;
    for (int64_t i = 0; i < groups; ++i) {
      sum += group[i].rows;
      fits &= group[i].tile < tiles;
      if (group[i].tile < tiles) of_last[group[i].tile] = group[i].stand_ins;
    }
    for (int64_t t = 0; t < tiles; ++t) fits &= of_last[t] == 0;
    if (!fits || sum != layout.count) refuse("cuts, tiles and their Gaussians do not fit together");
    int64_t there = 0;
    for (int64_t packet = 2; packet <= packets; ++packet) {
      if (is_finer[packet]) continue;
      group[there].packet = packet;
      there += packet <= file.packets;
      if (packet > file.packets) break;
    }
    groups = there;
    for (int64_t& packet : finer) packet = packet <= file.packets ? packet : 0;
    for (int64_t i = 0; i < groups; ++i) last[group[i].tile] = i;
  }
  int64_t stand_ins() const {
    int64_t sum = 0;
    for (int64_t t = 0; t < tiles; ++t) sum += base[t];
    return sum;
  }
};

// Moves rows of all arrays towards the front, over those that are not shown.
struct Shown {
  int64_t there = 0, left = 0;

  void take(int64_t rows, bool shown) {
    for (int i = 0; shown && there != left && i < decoded.count; ++i) {
      const Array& array = decoded.arrays[i];
      int64_t width = 1;
      for (int axis = 1; axis < array.axes; ++axis) width *= array.shape[axis];
      auto* values = static_cast<float*>(array.data);
      std::memmove(values + width * left, values + width * there, sizeof(float) * static_cast<size_t>(width * rows));
    }
    there += rows;
    left += shown ? rows : 0;
  }
  void finish() const {
    for (int i = 0; i < decoded.count; ++i) decoded.arrays[i].shape[0] = static_cast<uint32_t>(left);
  }
};

}  // namespace

void decode_tiles(Container& file) {
  Layout layout(file, {"first", "base", "groups", "finer", "times", "raw"});
  const Plan plan(file, layout);
  layout.check();
  int64_t n = plan.first + plan.stand_ins();
  for (int64_t i = 0; i < plan.groups; ++i) n += plan.group[i].rows + plan.group[i].stand_ins;
  file.allow(layout.decoded_bytes(n), n);
  Gaussians part(n, layout.degree, layout.scales);
  const auto decode = [&](int64_t packet, const char* of, int64_t rows) {
    Text prefix;
    prefix.put(packet), prefix.put("/"), prefix.put(of);
    layout.count = rows;
    Coarse coarse{.times = plan.times, .raw = plan.raw};
    if (rows || !*of) {
      if (!*of && plan.finer[packet]) {
        Text section;
        section.put(plan.finer[packet]), section.put("/finer");
        coarse.read(file, section.data, rows, 7 + layout.scales + 3 * ((layout.active + 1) * (layout.active + 1) - 1));
      }
      decode_rows(file, layout, prefix.data, part, coarse);
      if (coarse.largest > MAX_SYMBOL / plan.times) refuse("a coarse value of packet ", packet, " is beyond 2^30");
    }
    part.advance(rows, layout.scales);
  };
  decode(1, "", plan.first);
  decode(1, "stand-ins/", plan.stand_ins());
  for (int64_t i = 0; i < plan.groups; ++i) {
    decode(plan.group[i].packet, "", plan.group[i].rows);
    decode(plan.group[i].packet, "stand-ins/", plan.group[i].stand_ins);
  }
  Shown shown;
  shown.take(plan.first, true);
  for (int64_t t = 0; t < plan.tiles; ++t) shown.take(plan.base[t], plan.last[t] < 0);
  for (int64_t i = 0; i < plan.groups; ++i) {
    shown.take(plan.group[i].rows, true);
    shown.take(plan.group[i].stand_ins, plan.last[plan.group[i].tile] == i);
  }
  shown.finish();
  decoded.check_finite();
}

}  // namespace swz
