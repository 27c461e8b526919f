#include "wisp.h"

#include <algorithm>

#include <range_coded.h>
#include <ranges.h>

#include "gaussian_files.h"
#include "methods.h"
#include "model.h"
#include "sha256.h"

namespace swz {

namespace {

constexpr int MOST_SUBSETS = 16, MOST_PLANES = 2, MOST_PACKETS = MOST_SUBSETS * (MOST_PLANES + 2);
constexpr int64_t MOST_ROWS = 1 << 26, BYTES_OF_A_ROW = 4 * NUMBERS * 4 + 5 * 8 + 59 * 4, WIDEST = 4096, MOST_LAYERS = 16;
constexpr int64_t LEVELS = HIGHEST_LEVEL - LOWEST_LEVEL + 1, CONTEXTS = 185, CHILDREN = 60, ENDS = 180, MORE = 183;
constexpr int64_t INDEX_LIMIT = 1 << 21, AT_ONCE = 1 << 14;
constexpr int INDEX_BITS = 22;
constexpr int64_t POWERS_OF_3[] = {1, 3, 9, 27};
constexpr char DAMAGED[] = "entropy decoding: the words are damaged";

enum Kind { BASE_KIND, FINE_KIND, VIEW_KIND };
constexpr const char* KINDS[] = {"base", "fine", "view"};

struct Packet {
  int64_t subset, rows;
  Kind kind;
};

struct Order {
  Packet packets[MOST_PACKETS];
  int64_t count = 0, subsets = 0;
};

// Symbols of a packet.
struct Stream {
  const ExactTables& tables;
  Bytes data;
  int64_t state[4];
  bool has_read = false;

  Stream(const ExactTables& exact, Bytes bytes) : tables(exact), data(bytes) {
    if (data.left % 4) refuse(grouped(data.left), " coded bytes are not whole 32-bit words");
    session().store(arch_native::RangeReader(data.data, data.left));
  }
  splatwizard::RangeSession session() { return {data.data, data.left, state}; }
  void begin() {
    if (data.left == 0) refuse("symbols are expected, but there are no bytes");
    has_read = true;
  }
  // Bits of an even chance, one at a time.
  struct EvenBits {
    Stream& of;
    arch_native::RangeReader words;

    explicit EvenBits(Stream& stream) : of(stream), words(stream.data.data, stream.data.left) {
      of.session().load(words);
    }
    ~EvenBits() { of.session().store(words); }
    bool next() {
      const int bit = words.bit(1 << 23);
      if (bit < 0) refuse(DAMAGED);
      return bit;
    }
  };

  // Indices under tables t of the Gaussian, `number` being 8 t + 4.
  void indices(const int16_t* number, int64_t count, int32_t* found) {
    if (count == 0) return;
    begin();
    if (arch_native::range_entries(session(), tables.gaussian.tables(), number, count, found)) refuse(DAMAGED);
    int64_t escaped = 0;
    for (int64_t i = 0; i < count; ++i) {
      const int32_t radius = tables.gaussian.radius[number[i]];
      escaped += found[i] > 2 * radius;
      found[i] -= radius;
    }
    if (escaped) escapes(number, count, escaped, found);
  }

  void escapes(const int16_t* number, int64_t count, int64_t escaped, int32_t* found) {
    Buffer<int64_t> row(escaped), value(escaped), active(escaped);
    Buffer<uint8_t> negative(escaped), length(escaped);
    for (int64_t i = 0, at = 0; i < count; ++i)
      if (found[i] > tables.gaussian.radius[number[i]]) row[at++] = i;
    EvenBits bits(*this);
    for (int64_t i = 0; i < escaped; ++i) negative[i] = bits.next(), value[i] = length[i] = 1, active[i] = i;
    int most = 1;
    for (int64_t left = escaped; left;) {
      int64_t longer = 0;
      for (int64_t i = 0; i < left; ++i)
        if (bits.next()) active[longer++] = active[i];
      for (int64_t i = 0; i < longer; ++i) ++length[active[i]];
      left = longer;
      if (left && most >= INDEX_BITS) refuse("an escape code is damaged");
      most += left > 0;
    }
    for (int place = 1; place < most; ++place)
      for (int64_t i = 0; i < escaped; ++i)
        if (length[i] > place) value[i] = value[i] << 1 | bits.next();
    for (int64_t i = 0; i < escaped; ++i) {
      const int64_t size = value[i] + tables.gaussian.radius[number[row[i]]];
      if (size >= INDEX_LIMIT) refuse("an index is beyond ", grouped(INDEX_LIMIT), " steps");
      found[row[i]] = static_cast<int32_t>(negative[i] ? -size : size);
    }
  }

  void finish() {
    if (data.left == 0) return;
    const bool used_up =
        state[3] == data.left / 4 && static_cast<uint64_t>(state[2]) - static_cast<uint64_t>(state[0]) < uint64_t{1} << 33;
    if (!has_read || !used_up) refuse("bytes are left behind the last symbol");
  }
};

struct Walk {
  Context& context;
  const ExactTables& tables;
  Buffer<int32_t> zeros;  // shares of 0 of the octree [16, 185]
  Splats splats;
  int64_t planes;
  Rows rows[MOST_SUBSETS] = {};

  void packet(const Packet& packet, Bytes data) {
    Stream stream(tables, data);
    Rows& own = rows[packet.subset];
    if (packet.kind == BASE_KIND) {
      own = {splats.count, 1, packet.rows};
      if (packet.rows) octree(stream, packet.rows);
      std::memset(splats.missing.data + own.first, static_cast<int>(planes), static_cast<size_t>(packet.rows));
    }
    if (packet.kind == FINE_KIND) {
      for (int64_t begin = 0; begin < own.count; begin += AT_ONCE) refine(stream, own.part(begin, AT_ONCE));
      for (int64_t i = 0; i < own.count; ++i) --splats.missing[own[i]];
    } else {
      in_parts(own, [&](Rows part) {
        if (packet.kind == BASE_KIND)
          for (int number = 0; number < 3; ++number) block(stream, number, part, number ? planes : 0);
        else
          block(stream, 3, part, 0);
        for (int64_t i = 0; i < part.count && packet.kind == VIEW_KIND; ++i) splats.has_view[part[i]] = 1;
        context.learn(packet.kind == BASE_KIND ? BASE : LATENTS, part, splats);
      });
    }
    stream.finish();
  }

  // Each part doubles how many rows are known, between those.
  template <class Part>
  void in_parts(Rows own, const Part& part) {
    const int parts = own.count && own.first == 0 ? context.base_parts : context.later_parts;
    const auto strided = [&](int64_t first, int64_t step) {
      part(Rows{own.first + first, step, own.count > first ? (own.count - first + step - 1) / step : 0});
    };
    strided(0, int64_t{1} << (parts - 1));
    for (int j = parts - 2; j >= 0; --j) strided(int64_t{1} << j, int64_t{2} << j);
  }

  void octree(Stream& stream, int64_t count) {
    stream.begin();
    const int64_t before = splats.count;
    Buffer<int64_t> key(before), start(LEVELS + 1), cells(LEVELS * before), counts(LEVELS * before);
    for (int64_t i = 0; i < before; ++i)
      key[i] = splats.codes[i] << 3 * (HIGHEST_LEVEL - splats.levels[i]) << 5 | splats.levels[i];
    std::sort(key.data, key.data + before);
    int64_t at = 0;
    for (int64_t level = LOWEST_LEVEL; level <= HIGHEST_LEVEL; ++level) {
      start[level - LOWEST_LEVEL] = at;
      for (int64_t i = 0; i < before; ++i) {
        if ((key[i] & 31) < level) continue;
        const int64_t code = key[i] >> 5 >> 3 * (HIGHEST_LEVEL - level);
        if (at > start[level - LOWEST_LEVEL] && cells[at - 1] == code)
          ++counts[at - 1];
        else
          cells[at] = code, counts[at++] = 1;
      }
    }
    start[LEVELS] = at;
    const int32_t status = arch_native::decode_leaf_octree(
        stream.session(), {zeros.data, start.data, cells.data, counts.data, count}, splats.levels.data + before,
        splats.codes.data + before);
    if (status == splatwizard::BEYOND_LIMIT)
      refuse("the octree has more than the ", grouped(count), " splats that were announced");
    if (status == splatwizard::TOO_FEW)
      refuse("the octree has fewer than the ", grouped(count), " splats that were announced");
    if (status) refuse("the words of the octree are damaged");
    splats.count += count;
  }

  void keep(int64_t at, int64_t mean, int64_t scale) {
    splats.mean[at] = static_cast<int32_t>(clamped(mean, -VALUE_LIMIT, VALUE_LIMIT));
    splats.scale[at] = static_cast<int32_t>(clamped(scale, 0, HIGHEST_SCALE));
  }

  void block(Stream& stream, int number, Rows part, int64_t coarse) {
    if (part.count == 0) return;
    const Span columns = BLOCKS[number];
    Prediction found(part.count, columns.width());
    if (number == 0 || number == 3) context.look(part, splats);  // blocks 1 and 2 follow 0 with the same rows
    context.predict(number, part, splats, found);
    for (int64_t i = 0; i < part.count; ++i)
      for (int64_t c = 0; c < columns.width(); ++c)
        splats.multiplier[NUMBERS * part[i] + columns.first + c] = found.multiplier[columns.width() * i + c];
    for (int piece = 0; piece < PIECES_OF[number]; ++piece) {
      const Span own = PIECES[number][piece];
      const int64_t width = own.width();
      Buffer<int16_t> table(part.count * width);
      Buffer<int32_t> index(part.count * width);
      for (int64_t i = 0; i < part.count; ++i) {
        const int64_t from = columns.width() * i + own.first - columns.first, to = NUMBERS * part[i] + own.first;
        context.tie(number, piece, part[i], splats, found.mean.data + from, found.scale.data + from);
        for (int64_t c = 0; c < width; ++c) {
          keep(to + c, found.mean[from + c], found.scale[from + c]);
          table[width * i + c] = static_cast<int16_t>(8 * table_of(splats.scale[to + c], coarse) + CENTRED);
        }
      }
      stream.indices(table.data, table.size, index.data);
      for (int64_t i = 0; i < part.count; ++i)
        for (int64_t c = 0; c < width; ++c)
          splats.index[NUMBERS * part[i] + own.first + c] =
              static_cast<int32_t>(index[width * i + c] * POWERS_OF_3[coarse]);
    }
  }

  void refine(Stream& stream, Rows part) {
    const int64_t width = REFINED.width(), p = splats.missing[part[0]] - 1, size = width * part.count;
    Buffer<int64_t> before(size), coarse(size);
    Buffer<double> counts(3 * size);
    Buffer<int32_t> entry(size);
    for (int64_t i = 0; i < size; ++i) {
      const int64_t row = part[i / width], column = REFINED.first + i % width, at = NUMBERS * row + column;
      before[i] = splats.unit(row, column);
      coarse[i] = splats.index[at] / POWERS_OF_3[p + 1];  // whole
      const int64_t table = 8 * table_of(splats.scale[at], p) + CENTRED, radius = tables.gaussian.radius[table];
      for (int64_t k = 0; k < 3; ++k) {
        const int64_t fine = 3 * coarse[i] + k - 1;
        const bool inside = fine >= -radius && fine <= radius;
        counts[3 * i + k] = inside ? tables.gaussian.counts[tables.gaussian.first_count[table] + fine + radius] + 1.0 : 1;
      }
    }
    stream.begin();
    if (arch_native::range_choices(stream.session(), counts.data, size, entry.data)) refuse(DAMAGED);
    for (int64_t i = 0; i < size; ++i)
      splats.index[NUMBERS * part[i / width] + REFINED.first + i % width] =
          static_cast<int32_t>((3 * coarse[i] + entry[i] - 1) * POWERS_OF_3[p]);
    context.refine(part, before.data, splats);
  }

  // Latents that no packet holds, at their means.
  void finish() {
    const Span columns = LATENTS;
    for (int64_t first = 0, end; first < splats.count; first = end) {
      for (end = first + 1; end < splats.count && splats.has_view[end] == splats.has_view[first];) ++end;
      if (splats.has_view[first]) continue;
      const Rows all{first, 1, end - first};
      context.look(all, splats);
      for (int64_t begin = 0; begin < all.count; begin += AT_ONCE) {
        const Rows part = all.part(begin, AT_ONCE);
        Prediction found(part.count, columns.width());
        context.predict(3, part, splats, found);
        for (int64_t i = 0; i < part.count; ++i)
          for (int64_t c = 0; c < columns.width(); ++c) {
            const int64_t from = columns.width() * i + c, to = NUMBERS * part[i] + columns.first + c;
            keep(to, found.mean[from], found.scale[from]);
            splats.multiplier[to] = found.multiplier[from];
          }
      }
    }
  }
};

// Numbers of which flags say whether they are 0.
void take_flagged(Bytes& from, int64_t count, int64_t* found) {
  int64_t there = 0;
  bool positive = true;
  {
    RawBits flags(from, count, 1);
    for (int64_t i = 0; i < count; ++i) there += found[i] = static_cast<int64_t>(flags.next(1));
    flags.finish();
  }
  RawBits shares(from, there, 12);
  for (int64_t i = 0; i < count; ++i) {
    if (found[i] == 0) continue;
    found[i] = static_cast<int64_t>(shares.next(12));
    positive &= found[i] > 0;
  }
  shares.finish();
  if (!positive) refuse("a probability of the octree is 0");
}

// Shares of 0 of the octree's bits [16, 185].
Buffer<int32_t> octree_shares(Bytes& from) {
  const auto first = static_cast<int64_t>(from.integer(1)), last = static_cast<int64_t>(from.integer(1)),
             classes = static_cast<int64_t>(from.integer(1));
  if (first > last || last >= LEVELS)
    refuse("the octree is said to have levels ", first, "..", last, " of ", LEVELS);
  if (classes != 1 && classes != 3) refuse("the octree is said to have ", classes, " classes of cells");
  const int64_t levels = last - first + 1, children = CHILDREN * classes, own = children + classes;
  Buffer<int64_t> shared(4 * LEVELS), common(children), single(levels * own);
  for (int64_t i = 0; i < 4 * LEVELS; ++i) shared[i] = UNIT / 2;
  bool positive = true;
  RawBits of_kinds(from, 4 * levels, 12);
  for (int64_t i = 4 * first; i < 4 * (last + 1); ++i) {
    shared[i] = static_cast<int64_t>(of_kinds.next(12));
    positive &= shared[i] > 0;
  }
  of_kinds.finish();
  take_flagged(from, children, common.data);
  take_flagged(from, levels * own, single.data);
  if (!positive) refuse("a probability of the octree is 0");
  Buffer<int32_t> zeros(LEVELS * CONTEXTS);
  for (int64_t level = 0; level < LEVELS; ++level)
    for (int64_t x = 0; x < CONTEXTS; ++x) {
      int64_t share = shared[4 * level + (x < ENDS ? 0 : x < MORE ? 1 : x - MORE + 2)];
      if (x < children && common[x] > 0) share = common[x];
      const int64_t column = x < children ? x : x >= ENDS && x < ENDS + classes ? children + x - ENDS : -1;
      if (level >= first && level <= last && column >= 0) {
        const int64_t mine = single[own * (level - first) + column];
        if (mine > 0) share = mine;
      }
      zeros[CONTEXTS * level + x] = static_cast<int32_t>((1 - static_cast<double>(share) / UNIT) * ((1 << 24) - 2)) + 1;
    }
  return zeros;
}

const Json* list(const Container& file, const char* key, int64_t least, int64_t most) {
  const Json* found = file.value(key);
  if (found == nullptr || found->kind != Json::ARRAY || found->length < least || found->length > most)
    refuse("header value '", key, "' is not a list of ", least, " to ", most);
  return found;
}

int64_t within(const Json* number, int64_t most, const char* key) {
  if (number->kind != Json::INTEGER || number->integer < 0 || number->integer > most)
    refuse("header value '", key, "' is out of range");
  return number->integer;
}

void take_numbers(const Container& file, const char* key, int64_t count, double* found) {
  for (const Json* number = list(file, key, count, count)->first; number; number = number->next) {
    if (!number->is_number()) refuse("header value '", key, "' must be ", count, " numbers");
    if (!(__builtin_fabs(number->number) <= 1e30)) refuse("header value '", key, "' is out of range");
    *found++ = number->number;
  }
}

Order order_of(const Container& file, int64_t planes) {
  Order order;
  int64_t rows[MOST_SUBSETS] = {}, seen[MOST_SUBSETS][3] = {}, sum = 0;
  for (const Json* row = list(file, "order", 0, MOST_PACKETS)->first; row; row = row->next) {
    if (row->kind != Json::ARRAY || row->length != 3) refuse("a packet of the header is not [subset, kind, rows]");
    const Json *subset = row->first, *kind = subset->next, *count = kind->next;
    Packet& packet = order.packets[order.count++];
    packet.subset = within(subset, MOST_SUBSETS - 1, "order");
    packet.rows = within(count, MOST_ROWS, "order");
    int number = 0;
    while (number < 3 && !kind->is(KINDS[number])) ++number;
    if (number == 3) refuse("a packet of the header is not [subset, kind, rows]");
    packet.kind = static_cast<Kind>(number);
    int64_t* parts = seen[packet.subset];
    if (number != BASE_KIND && parts[BASE_KIND] == 0)
      refuse("subset ", packet.subset, " has no packet 'base' before others");
    if (parts[BASE_KIND] && rows[packet.subset] != packet.rows)
      refuse("the packets of subset ", packet.subset, " differ in their rows");
    rows[packet.subset] = packet.rows;
    ++parts[number];
    sum += number == BASE_KIND ? packet.rows : 0;
    order.subsets = packet.subset >= order.subsets ? packet.subset + 1 : order.subsets;
  }
  for (int64_t subset = 0; subset < order.subsets; ++subset)
    if (seen[subset][0] != 1 || seen[subset][1] != planes || seen[subset][2] != 1)
      refuse("subset ", subset, " has not the packets that it needs");
  if (sum > MOST_ROWS) refuse("more than ", grouped(MOST_ROWS), " splats");
  return order;
}

const char* section_of(int64_t packet) {
  static char name[] = "packet.01";
  name[7] = static_cast<char>('0' + (packet + 1) / 10);
  name[8] = static_cast<char>('0' + (packet + 1) % 10);
  return name;
}

// How many packets are there.
int64_t check_sections(const Container& file, const Order& order) {
  bool same = file.count >= 2 && std::strcmp(file.sections[0].name, "networks") == 0;
  for (int64_t i = 1; i < file.count && same; ++i)
    same = i <= order.count && std::strcmp(file.sections[i].name, section_of(i - 1)) == 0;
  const int64_t declared = file.header->find("sections")->length;
  if (!same || declared != order.count + 1) refuse("sections are not those of the order of packets");
  return file.count - 1;
}

// Rows of the packets that are there; refuses more than the file may stand for.
int64_t rows_there(const Container& file, const Order& order) {
  int64_t rows = 0;
  for (int64_t i = 0; i < check_sections(file, order); ++i)
    rows += order.packets[i].kind == BASE_KIND ? order.packets[i].rows : 0;
  file.allow(BYTES_OF_A_ROW * rows, rows);
  return rows;
}

// A file of which some packets are decoded.
struct Coded {
  Appearance looks;
  Order order;
  Context& context;
  Walk walk;
  int64_t done = 0;

  void go_on(Container& file) {
    const int64_t packets = check_sections(file, order);
    file.section("networks");  // read before
    walk.splats.make_room(rows_there(file, order));
    bool has_base = done > 0;
    for (int64_t i = 0; i < packets; ++i) {
      const Bytes content = file.section(section_of(i));
      if (i < done) continue;
      has_base &= order.packets[i].kind == VIEW_KIND;
      char name[16];
      std::strcpy(name, section_of(i));
      const Blame blame(name);
      walk.packet(order.packets[i], content);
    }
    done = packets;
    walk.finish();
    if (!file.is_first_part) context.forget();
    const Blame blame("networks");
    put_gaussians(walk.splats, looks, walk.tables, has_base);
  }
};

Coded* coded = nullptr;

// Level, cell, indices, means and multipliers of each row.
void put_integers(Sha256& sha) {
  const Splats& splats = coded->walk.splats;
  for (int64_t row = 0; row < splats.count; ++row) {
    int32_t values[4 + 3 * NUMBERS] = {static_cast<int32_t>(splats.levels[row])};
    for (int64_t bit = 0; bit < 3 * HIGHEST_LEVEL; ++bit)
      values[1 + bit % 3] |= (splats.codes[row] >> bit & 1) << bit / 3;
    const Buffer<int32_t>* parts[] = {&splats.index, &splats.mean, &splats.multiplier};
    for (int64_t i = 0; i < 3; ++i)
      std::memcpy(values + 4 + NUMBERS * i, parts[i]->data + NUMBERS * row, sizeof(int32_t) * NUMBERS);
    sha.put(values, sizeof(values));
  }
}

}  // namespace

Splats::Splats(int64_t rows)
    : most(rows), levels(rows), codes(rows), mean(NUMBERS * rows), scale(NUMBERS * rows), multiplier(NUMBERS * rows),
      index(NUMBERS * rows), missing(rows), has_view(rows) {
  index.clear();  // of latents that no packet holds
  has_view.clear();
}

void Splats::make_room(int64_t rows) {
  if (rows <= most) return;
  Splats larger(rows);
  const auto keep = [&](auto& own, const auto& from, int64_t width) {
    std::memcpy(own.data, from.data, sizeof(*own.data) * static_cast<size_t>(width * count));
  };
  keep(larger.levels, levels, 1), keep(larger.codes, codes, 1), keep(larger.missing, missing, 1);
  keep(larger.has_view, has_view, 1), keep(larger.mean, mean, NUMBERS), keep(larger.scale, scale, NUMBERS);
  keep(larger.multiplier, multiplier, NUMBERS), keep(larger.index, index, NUMBERS);
  larger.count = count;
  *this = static_cast<Splats&&>(larger);
}

void decode_wisp(Container& file) {
  auto& tables = *new ExactTables(exact_tables());  // all of it stays as long as the instance
  const Json* stated = list(file, "tables", 2, 2)->first;
  tables.check(within(stated, UINT32_MAX, "tables"), within(stated->next, UINT32_MAX, "tables"));
  Appearance looks{};
  looks.planes = file.integer("planes", 0, MOST_PLANES);
  const Json* kind = file.value("context");
  const bool by_pyramid = kind != nullptr && kind->is("pyramid");
  if (kind == nullptr || !(by_pyramid || kind->is("none"))) refuse("header value 'context' must be one of none, pyramid");
  const Order order = order_of(file, looks.planes);
  check_sections(file, order);
  take_numbers(file, "low", 3, looks.low);
  take_numbers(file, "base_steps", NUMBERS, looks.base_steps);
  for (const double step : looks.base_steps)
    if (!(step > 0)) refuse("a base step is not positive");
  const Json* edge = file.value("edge");
  if (edge == nullptr || !edge->is_number() || !(edge->number >= 1e-30 && edge->number <= 1e30))
    refuse("header value 'edge' must be a number in 1e-30..1e+30");
  looks.edge = edge->number;
  int64_t shapes[3][3], layer = 0;
  for (const Json* row = list(file, "appearance", 3, 3)->first; row; row = row->next, ++layer) {
    if (row->kind != Json::ARRAY || row->length != 3) refuse("header value 'appearance' is out of range");
    int64_t at = 0;
    for (const Json* each = row->first; each; each = each->next, ++at)
      shapes[layer][at] = within(each, at < 2 ? WIDEST : 1, "appearance");
  }
  looks.sh_degree = file.integer("sh_degree", 0, 3);
  rows_there(file, order);

  Bytes data = file.section("networks");
  Context* context;
  Buffer<int32_t> zeros;
  {
    const Blame blame("networks");
    zeros = octree_shares(data);
    context = by_pyramid ? &read_pyramid(data, tables) : &read_statistics(data);
    for (int64_t i = 0; i <= looks.planes; ++i)
      for (uint8_t& strength : looks.strengths[i]) strength = static_cast<uint8_t>(data.integer(1));
    EightBitLayer* layers[] = {&looks.basis, &looks.hidden, &looks.last};
    for (int i = 0; i < 3; ++i) layers[i]->read(data, shapes[i][0], shapes[i][1], shapes[i][2] == 1);
    data.finish();
  }
  coded = new Coded{static_cast<Appearance&&>(looks), order, *context,
                    {*context, tables, static_cast<Buffer<int32_t>&&>(zeros), Splats(0), looks.planes}};
  coded->go_on(file);
  go_on = [](Container& more) { coded->go_on(more); };
  hash_of_integers = put_integers;
}

}  // namespace swz
