"""Chapter 6: The files of each method, `wisp`."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from bitstream_page.building_blocks import RangeWords, bernoulli_model, cumulative, raw_bits, symbols_by_table
from bitstream_page.entropy_models import ExactTables, columns
from bitstream_page.fields import Bytes, check
from bitstream_page.integer_networks import network

LIMIT = 1 << 20
BASE, REFINED, LATENTS = slice(0, 10), slice(1, 10), slice(10, 22)
BLOCKS = (slice(0, 1), slice(1, 7), slice(7, 10), slice(10, 22))
PIECES = {0: [(0, 1)], 1: [(1, 4), (4, 7)], 7: [(7, 8), (8, 9), (9, 10)], 10: [(10, 14), (14, 18), (18, 22)]}
GROUPS = (1, 5, 1, 3, 12)
NETWORKS = ((69, 32, 3), (70, 48, 14), (76, 32, 7), (79, 40, 25))
STEPS = ([0], [0] * 5 + [1], [0] * 3, [0] * 12)
Layer = tuple[np.ndarray, np.ndarray]
Cell = tuple[int, int]
"""Level and Morton code."""


def layers(file: Bytes, shapes: Sequence[Sequence[int]]) -> list[Layer]:
    """Weights and biases in eight bits, f32."""
    found = []
    for outputs, inputs, biases in shapes:
        (flat,) = columns(file.take(file.varint()), outputs * inputs, 1)
        exponents = np.array(file.unpack(f"{outputs}b"))
        own = file.one("b")
        bias = np.array(file.unpack(f"{outputs * biases}h"), np.float64)
        weights = np.reshape(flat, (outputs, inputs)) * 2.0 ** exponents[:, None]
        bias = bias * 2.0**own if biases else np.zeros(outputs)
        found.append((weights.astype(np.float32), bias.astype(np.float32)))
    return found


def shares_of(file: Bytes) -> dict[tuple[int, int], int]:
    """Share of a 1 by level and context of the octree."""
    a, b, k = file.unpack("BBB")
    check(a <= b <= 15 and k in (1, 3), "levels and classes of the octree")
    levels = range(a + 3, b + 4)
    of_kind = dict(zip(itertools.product(levels, range(4)), raw_bits(file, 4 * len(levels), 12), strict=True))

    def flagged(keys: Sequence[Any]) -> dict[Any, int]:
        there = [key for key, flag in zip(keys, raw_bits(file, len(keys), 1), strict=True) if flag]
        return dict(zip(there, raw_bits(file, len(there), 12), strict=True))

    common = flagged(range(60 * k))
    own = flagged(list(itertools.product(levels, [*range(60 * k), *range(180, 180 + k)])))
    found = {}
    for level, x in itertools.product(levels, range(185)):
        kind = 0 if x < 180 else 1 if x < 183 else x - 181
        found[level, x] = own.get((level, x)) or common.get(x) or of_kind[level, kind]
    return found


def step(code: int, level: int, axis: int, by: int) -> int | None:
    """The Morton code of the cell beside one, along an axis; None outside the cube."""
    place = sum((code >> (3 * i + axis) & 1) << i for i in range(level)) + by
    if not 0 <= place < 1 << level:
        return None
    rest = code & ~sum(1 << (3 * i + axis) for i in range(level))
    return rest | sum((place >> i & 1) << (3 * i + axis) for i in range(level))


def octree(words: RangeWords, shares: dict[Cell, int], rows: int, earlier: Sequence[Cell]) -> list[Cell]:
    """Cells of a subset of splats, in the order of its rows."""
    if not rows:
        return []

    def bit(level: int, context: int) -> int:
        return words.symbol(bernoulli_model(shares[level, context] / 4096))

    found: list[Cell] = []
    nodes = list(range(64))
    for level in range(3, 19):
        known = Counter(code >> 3 * (at - level) for at, code in earlier if at >= level)
        bits: dict[int, list[int]] = {node: [] for node in nodes}
        for child in range(8):
            f = child.bit_count()
            for node in nodes:
                own, occupied, near = bits[node], 0, 0
                if child == 7 and level > 3 and not any(own):
                    own.append(1)
                    continue
                for axis in range(3):
                    is_far = child >> axis & 1
                    beside = step(node, level - 1, axis, 1 if is_far else -1)
                    other = bits.get(-1 if beside is None else beside)
                    if is_far:
                        sibling = child ^ 1 << axis
                        occupied += own[sibling] + (0 if other is None else other[sibling])
                    else:
                        near += other is not None
                k = min(known[8 * node + child], 2)
                context = 60 * k + (0, 8, 26, 46)[f] + 2 * (occupied * (4 - f) + near) + any(own)
                own.append(bit(level, context))
        children = [8 * node + child for node in nodes for child in range(8) if bits[node][child]]
        ends = {child: 1 if level == 18 else bit(level, 180 + min(known[child], 2)) for child in children}
        active = [child for child in children if ends[child]]
        for _ in range(15):
            active = [child for child in active if bit(level, 183)]
            for child in active:
                ends[child] += 1
        found += [(level, child) for child in children for _ in range(ends[child])]
        check(len(found) <= rows, "splats of an octree")
        nodes = [] if level == 18 else [child for child in children if not ends[child] or bit(level, 184)]
    check(len(found) == rows, "splats of an octree")
    return sorted(found, key=lambda cell: (cell[1] << 3 * (18 - cell[0]), cell[0]))


class Means:
    """Sums over cells around splats, and their shrunk means."""

    def __init__(self, prior: np.ndarray) -> None:
        self.prior = prior
        self.cells: list[Cell] = []
        self.members: Counter[Cell] = Counter()
        self.sums: dict[Cell, np.ndarray] = {}  # 22 values, 22 activities, numbers of base and of latents

    def around(self, splat: int) -> list[Cell]:
        level, code = self.cells[splat]
        return [(g, code >> 3 * (level - g)) for g in range(min(level, 15) + 1)]

    def announce(self, cells: Sequence[Cell]) -> None:
        for cell in cells:
            self.cells.append(cell)
            self.members.update(self.around(len(self.cells) - 1))

    def add(self, splat: int, row: np.ndarray) -> None:
        for cell in self.around(splat):
            self.sums[cell] = self.sums.get(cell, 0) + row

    def is_shared(self, cell: Cell) -> bool:
        return cell[0] == 0 or self.members[cell] > 1

    def mean(self, cell: Cell, seen: dict[Cell, np.ndarray]) -> np.ndarray:
        """Values and activities [44]."""
        if cell not in seen:
            level, code = cell
            if level == 0:
                seen[cell] = np.concatenate([self.prior, np.full(22, 256)])
            else:
                above = self.mean((level - 1, code >> 3), seen)
                sums = self.sums.get(cell, np.zeros(46, np.int64))
                n = np.tile(np.repeat(sums[44:], (10, 12)), 2)
                seen[cell] = (sums[:44] + 2 * above) // (n + 2) if self.is_shared(cell) else above
        return seen[cell]

    def features(self, splats: Sequence[int]) -> np.ndarray:
        """Features [n,69]."""
        seen: dict[Cell, np.ndarray] = {}
        found = []
        for splat in splats:
            level, way = self.cells[splat][0], self.around(splat)
            fine, coarse, third = way[min(level, 15)], way[level - 3], way[min(level - 1, 15)]
            counts = [
                int(self.sums[cell][44]) if cell in self.sums and self.is_shared(cell) else 0 for cell in (fine, coarse)
            ]
            means = [self.mean(fine, seen)[:22], self.mean(coarse, seen)[:22], self.mean(third, seen)[22:]]
            numbers = [256 * level, *(256 * min(n, 15) for n in counts)]
            found.append(np.concatenate([*(np.clip(m, -LIMIT, LIMIT) for m in means), numbers]))
        return np.array(found, np.int64).reshape(-1, 69)


class Statistics:
    """Context `none`."""

    parts = (1, 1)

    def __init__(self, file: Bytes) -> None:
        rows = file.one("B")
        self.row = file.unpack("16B")
        self.multipliers = np.array(file.unpack("22H"))
        self.means = np.reshape(file.unpack(f"{22 * rows}h"), (rows, 22)) * 16
        self.levels = np.reshape(file.unpack(f"{22 * rows}B"), (rows, 22))

    def announce(self, cells: Sequence[Cell]) -> None:
        pass

    def predict(self, block: slice, splats: Sequence[int], state: Splats) -> tuple[np.ndarray, ...]:
        rows = [self.row[state.cells[splat][0] - 3] for splat in splats]
        mean = self.means[rows, block]
        return mean, self.levels[rows, block] * 4096, np.broadcast_to(self.multipliers[block], mean.shape)

    def tied(self, first: int, before: slice, splats: Sequence[int], state: Splats) -> tuple[Any, Any]:
        return 0, 0

    def learn(self, splats: Sequence[int], columns: slice, before: np.ndarray | None, state: Splats) -> None:
        pass


class Pyramid:
    """Context `pyramid`."""

    parts = (6, 4)

    def __init__(self, file: Bytes, tables: ExactTables) -> None:
        self.tables = tables
        flags = file.one("B")
        check(flags < 4, "flags")
        self.adaptive, halves = flags % 2 == 1, flags // 2
        self.means = Means(np.array(file.unpack("22h")) * 16)
        flat = layers(file, [s for i, h, o in NETWORKS for s in ((h >> halves, i, 1), (o, h >> halves, 1))])
        self.networks = [flat[i : i + 2] for i in range(0, 8, 2)]
        self.ties = {}
        for block in BLOCKS:
            for first, last in PIECES[block.start][1:]:
                c, n = last - first, first - block.start
                exponents = np.array(file.unpack(f"{2 * c}b"))
                check(exponents.min() >= -12 and exponents.max() <= 5, "exponents of ties")
                weights = np.reshape(file.unpack(f"{2 * c * n}b"), (2 * c, n))
                check(bool(abs(weights).max() <= 127), "weights of ties")
                # 2^exponent as a whole number over 2^12
                self.ties[first] = weights << (exponents + 12)[:, None]

    def announce(self, cells: Sequence[Cell]) -> None:
        self.means.announce(cells)

    def predict(self, block: slice, splats: Sequence[int], state: Splats) -> tuple[np.ndarray, ...]:
        number, n = BLOCKS.index(block), block.stop - block.start
        if block.start in (0, 10):
            self.features = self.means.features(splats)
        inputs = np.concatenate([self.features, state.values(splats, slice(0, block.start))], axis=1)
        outputs = network(self.networks[number], np.ones(NETWORKS[number][2]), inputs)
        j = np.clip((outputs[:, 2 * n :] + (1 << 15)) >> 9, 0, 127)
        m = np.array(self.tables.multipliers)[j][:, STEPS[number]] if self.adaptive else np.full((len(splats), n), 4096)
        return self.features[:, block] + outputs[:, :n], outputs[:, n : 2 * n], m

    def tied(self, first: int, before: slice, splats: Sequence[int], state: Splats) -> tuple[Any, Any]:
        if first not in self.ties:
            return 0, 0
        tie = self.ties[first]
        c = len(tie) // 2
        residuals = np.clip(state.k[splats, before] * state.m[splats, before], -LIMIT, LIMIT)
        a = [round(4096 / math.sqrt(d * d + 1 / 12)) for d in self.tables.deviations]
        sizes = np.minimum(abs(state.k[splats, before]) * np.array(a)[state.table(splats, before, 0)], 4 * 4096)
        return (residuals @ tie[:c].T) >> 12, (sizes @ tie[c:].T) >> 12

    def learn(self, splats: Sequence[int], columns: slice, before: np.ndarray | None, state: Splats) -> None:
        values = np.clip(state.values(splats, columns), -LIMIT, LIMIT)
        for i, splat in enumerate(splats):
            row = np.zeros(46, np.int64)
            row[columns] = values[i] - (0 if before is None else np.clip(before[i], -LIMIT, LIMIT))
            if before is None:
                row[22:44][columns] = 256 * np.minimum(abs(state.k[splat, columns]), 15)
                row[44 if columns == BASE else 45] = 1
            self.means.add(splat, row)


class Splats:
    """Splats known so far: cells, and [N,22] means, scale levels, multipliers and indices."""

    def __init__(self) -> None:
        self.cells: list[Cell] = []
        self.mean, self.scale, self.m, self.k = (np.zeros((0, 22), np.int64) for _ in range(4))
        self.missing = np.zeros(0, np.int64)  # refinements

    def append(self, cells: Sequence[Cell], missing: int) -> list[int]:
        start = len(self.cells)
        self.cells += cells
        for name in ("mean", "scale", "m", "k"):
            setattr(self, name, np.concatenate([getattr(self, name), np.zeros((len(cells), 22), np.int64)]))
        self.missing = np.concatenate([self.missing, np.full(len(cells), missing)])
        return list(range(start, len(self.cells)))

    def values(self, splats: Sequence[int], columns: slice) -> np.ndarray:
        found: np.ndarray = self.mean[splats, columns] + self.k[splats, columns] * self.m[splats, columns]
        return found

    def table(self, splats: Sequence[int], columns: slice, p: int) -> np.ndarray:
        """t of the tables of the Gaussian."""
        return np.clip((self.scale[splats, columns] - 39624 * p + 2048) >> 12, 0, 63)


def indices(words: RangeWords, tables: ExactTables, t: np.ndarray) -> np.ndarray:
    """Indices in the shape of their tables."""
    numbers = t.reshape(-1).tolist()
    radius = [tables.radius["gaussian"][number] for number in numbers]
    entries = symbols_by_table(words, tables.tables["gaussian"], [8 * number + 4 for number in numbers])
    found = [entry - r for entry, r in zip(entries, radius, strict=True)]
    escaped = [i for i, entry in enumerate(entries) if entry == 2 * radius[i] + 1]
    even = bernoulli_model(0.5)
    negative = {i: words.symbol(even) for i in escaped}
    length, longer = dict.fromkeys(escaped, 1), escaped
    while longer:
        longer = [i for i in longer if words.symbol(even)]
        for i in longer:
            length[i] += 1
            check(length[i] <= 22, "length of an escape")
    value = dict.fromkeys(escaped, 1)
    for place in range(1, max(length.values(), default=1)):
        for i in escaped:
            if length[i] > place:
                value[i] = 2 * value[i] + words.symbol(even)
    for i in escaped:
        found[i] = (-1 if negative[i] else 1) * (value[i] + radius[i])
        check(abs(found[i]) < 1 << 21, "an index")
    return np.reshape(found, t.shape)


def parts_of(rows: Sequence[int], w: int) -> list[Sequence[int]]:
    return [rows[:: 1 << w - 1], *(rows[1 << j :: 2 << j] for j in range(w - 2, -1, -1))]


def coded_splats(static: dict[str, Any], sections: dict[str, bytes], tables: ExactTables) -> tuple[Splats, Bytes]:
    """The integers of a file, and what is left of its section `networks`."""
    check(static["tables"] == [tables.version, tables.crc], "other tables")
    planes = static["planes"]
    file = Bytes(sections["networks"])
    shares = shares_of(file)
    context = Pyramid(file, tables) if static["context"] == "pyramid" else Statistics(file)
    state, rows_of = Splats(), {}
    viewed: set[int] = set()
    for number, (subset, kind, count) in enumerate(static["order"][: len(sections) - 1]):
        data = sections[f"packet.{number + 1:02d}"]
        words = RangeWords(data)
        if kind == "base":
            cells = octree(words, shares, count, state.cells)
            rows_of[subset] = state.append(cells, planes)
            context.announce(cells)
        rows = rows_of[subset]
        w = context.parts[0 if subset == static["order"][0][0] else 1]
        if kind == "fine" and rows:
            refine(words, tables, rows, state, context)
        for part in parts_of(rows, w) if kind != "fine" else []:
            for block in BLOCKS[:3] if kind == "base" else BLOCKS[3:]:
                if part:
                    code_block(
                        words, tables, block, part, planes if kind == "base" and block.start else 0, state, context
                    )
            context.learn(part, BASE if kind == "base" else LATENTS, None, state)
        viewed |= {subset} if kind == "view" else set()
        check(next(words.words, None) is None, "words are left")
    rows = [row for subset, own in rows_of.items() if subset not in viewed for row in own]
    if rows:
        mean, scale, m = context.predict(LATENTS, rows, state)
        state.mean[rows, LATENTS] = np.clip(mean, -LIMIT, LIMIT)
        state.scale[rows, LATENTS] = np.clip(scale, 0, 63 * 4096)
        state.m[rows, LATENTS] = m
    return state, file


def code_block(
    words: RangeWords, tables: ExactTables, block: slice, rows: Sequence[int], p: int, state: Splats,
    context: Pyramid | Statistics,
) -> None:  # fmt: skip
    mean, scale, m = context.predict(block, rows, state)
    for first, last in PIECES[block.start]:
        own, piece = slice(first - block.start, last - block.start), slice(first, last)
        more_mean, more_scale = context.tied(first, slice(block.start, first), rows, state)
        state.mean[rows, piece] = np.clip(mean[:, own] + more_mean, -LIMIT, LIMIT)
        state.scale[rows, piece] = np.clip(scale[:, own] + more_scale, 0, 63 * 4096)
        state.m[rows, piece] = m[:, own]
        state.k[rows, piece] = indices(words, tables, state.table(rows, piece, p)) * 3**p


def refine(
    words: RangeWords, tables: ExactTables, rows: Sequence[int], state: Splats, context: Pyramid | Statistics
) -> None:
    p = int(state.missing[rows[0]]) - 1
    before = state.values(rows, REFINED)
    coarse = state.k[rows, REFINED] // 3 ** (p + 1)
    finer = []
    for c, t in zip(coarse.reshape(-1).tolist(), state.table(rows, REFINED, p).reshape(-1).tolist(), strict=True):
        radius, counts = tables.radius["gaussian"][t], tables.tables["gaussian"][8 * t + 4]
        three = [counts[k + radius] if abs(k) <= radius else 1 for k in (3 * c - 1, 3 * c, 3 * c + 1)]
        finer.append(3 * c - 1 + words.symbol(cumulative(three)))
    state.k[rows, REFINED] = np.reshape(finer, coarse.shape) * 3**p
    state.missing[rows] = p
    context.learn(rows, REFINED, before, state)


def pulled(state: Splats, strengths: np.ndarray, tables: ExactTables) -> np.ndarray:
    """Indices with what centroids add, f64 [N,22]."""
    group = np.repeat(np.arange(5), GROUPS)
    found = state.k.astype(np.float64)
    every = list(range(len(state.cells)))
    t = state.table(every, slice(None), 0)
    for i, j in itertools.product(every, range(22)):
        missing = int(state.missing[i]) if 1 <= j < 10 else 0
        strength, k, d = int(strengths[missing, group[j]]), abs(int(state.k[i, j])), tables.deviations[t[i, j]]
        if strength and k:
            half = 3**missing / 2
            low, high = (k - half) / d, (k + half) / d
            mass = math.sqrt(math.pi / 2) * (math.erfc(low / math.sqrt(2)) - math.erfc(high / math.sqrt(2)))
            mean = k - half if mass < 1e-280 else d * (math.exp(-low * low / 2) - math.exp(-high * high / 2)) / mass
            found[i, j] += (1 if state.k[i, j] > 0 else -1) * strength / 255 * (mean - k)
    return found


def wisp(static: dict[str, Any], sections: dict[str, bytes], tables: ExactTables) -> dict[str, np.ndarray]:
    """Gaussians, their covariances in place of scales and rotations, and the integers that they come from."""
    state, file = coded_splats(static, sections, tables)
    strengths = np.reshape(file.unpack(f"{5 * (static['planes'] + 1)}B"), (-1, 5))
    basis, first, last = layers(file, static["appearance"])
    file.done()
    units = state.mean + pulled(state, strengths, tables) * state.m
    numbers = units * np.array(static["base_steps"]) / 4096
    there = [count for _, kind, count in static["order"][: len(sections) - 1] if kind == "base"]
    swell = static.get("swell", [])
    if 0 < len(there) <= len(swell):
        check(len(swell[len(there) - 1]) == 2 * len(there), "swell")
        size, opacity = np.reshape(swell[len(there) - 1], (-1, 2)).T / 32
        numbers[:, 6] += np.repeat(size, there)
        numbers[:, 0] += np.repeat(opacity, there)
    numbers = numbers.astype(np.float32)
    levels = np.array([level for level, _ in state.cells], np.int64)
    codes = [code for _, code in state.cells]
    cells = np.array(
        [[sum((code >> (3 * i + axis) & 1) << i for i in range(18)) for axis in range(3)] for code in codes]
    )
    edges = static["edge"] / 2.0**levels
    colour, latents = numbers[:, 7:10], numbers[:, 10:]
    hidden = np.maximum(np.concatenate([latents, colour], axis=1) @ first[0].T + first[1], 0)
    rest = latents @ basis[0].T + hidden @ last[0].T + last[1]
    y, c1, c2 = colour.astype(np.float64).T
    rgb = np.stack([y / 3**0.5 + c1 / 2**0.5 - c2 / 6**0.5, y / 3**0.5 + 2 * c2 / 6**0.5,
                    y / 3**0.5 - c1 / 2**0.5 - c2 / 6**0.5], 1)  # fmt: skip
    return {
        "means": (np.array(static["low"]) + (cells + 0.5) * edges[:, None]).astype(np.float32),
        "opacity_logits": numbers[:, 0],
        "sh_dc": ((rgb - 0.5) / 0.28209479177387814)[:, None].astype(np.float32),
        "sh_rest": rest.reshape(len(rest), -1, 3),
        "covariances": covariances(numbers, edges, static["edge"]),
        "levels": levels, "cells": cells, "mean": state.mean, "m": state.m, "k": state.k,
    }  # fmt: skip


def covariances(numbers: np.ndarray, edges: np.ndarray, root: float) -> np.ndarray:
    """Covariances [N,3,3] of shapes and sizes."""
    found = []
    for row, edge in zip(numbers.astype(np.float64), edges, strict=True):
        d, size = row[1:6], row[6] + math.log(edge)
        zz = math.sqrt(6) * d[1] / 3  # 2 D_zz - D_xx - D_yy = 3 D_zz, the trace being 0
        xx, yy = (-zz + math.sqrt(2) * d[0]) / 2, (-zz - math.sqrt(2) * d[0]) / 2
        xy, xz, yz = d[2:] / math.sqrt(2)
        values, vectors = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) + size * np.eye(3))
        values = np.clip(values, math.log(1e-6 * root), math.log(root))
        found.append(vectors @ np.diag(np.exp(2 * values)) @ vectors.T)
    return np.reshape(found, (-1, 3, 3))
