"""Position codec `octree`: integer points as the occupancy of an octree, breadth first, range coded.

Each inner node is a byte with a bit for every child that holds a point. It is coded with a count table selected by the
level and by how many children the node's parent has (1, 2, 3, 4 or more); a level may reuse the latest table. Once
every node holds a single point the remaining bits of the points go raw. Points come out in Morton order.
Source: specification of the codec library, point positions.

Layout (docs/bitstream.md): u8 version, u8 bits, varint points, varint distinct points, u8 levels that are coded,
u8 actions for each of them, tables, varint length and range-coded words, u32 CRC-32 of the occupancies, raw suffixes,
duplicates (`columns`), u32 CRC-32 of the points.
"""

from __future__ import annotations

from typing import NoReturn

import numpy as np
import numpy.typing as npt
import torch

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum
from sw_codecs.bits.packing import ByteReader, pack_fixed, packed_size, unpack_fixed, write_varint
from sw_codecs.coders.count_tables import code_counts, count_codes, pack_tables, table_bits, unpack_tables
from sw_codecs.coders.model_spec import Tables
from sw_codecs.coders.symbol_stream import SymbolReader, SymbolWriter
from sw_codecs.exact_native import has_exact
from sw_codecs.fast import exact_operations
from sw_codecs.positions import morton
from sw_codecs.positions.duplicates import decode_duplicates, encode_duplicates, without_duplicates
from sw_codecs.positions.ordering import spatial_order
from sw_codecs.positions.point_limit import MAX_POINTS, check_written, point_limit

VERSION = 1
CONTEXTS = 4  # by the number of the parent's children; 4 stands for 4..8
OCCUPANCIES = 255
UNIFORM, OWN, LATEST = 0, 1, 2  # which count table a level and context takes
BEYOND_LIMIT = 3  # status of the kernel
CRC_DIFFERS = "the decoded symbols do not match their CRC-32: damaged data or a wrong model"

_POPCOUNT = np.array([bin(i).count("1") for i in range(256)], np.int64)
_CHILDREN = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1, bitorder="little").astype(bool)  # [256, 8]


class Octree:
    """Codes [N,3] integer points, up to 21 bits an axis; duplicates are kept.

    max_points  `decode` refuses files that claim more

    `Octree.sort(points)` gives the indices that bring points (array or tensor) into the order that `encode` asks for.
    """

    sort = staticmethod(spatial_order)

    def __init__(self, *, max_points: int = MAX_POINTS) -> None:
        self.max_points = max_points

    def encode(self, points: npt.ArrayLike, bits: int) -> bytes:
        """points [N,3] integers, 0 <= p < 2^bits, in Morton order (`sw_codecs.positions.morton.sort`).

        Raises ValueError if they are not, SplatwizardError for more points than a reader accepts (`point_limit`).
        """
        codes = morton.sorted_codes(points, bits)
        leaves, extra = without_duplicates(codes)
        out = bytes([VERSION, bits]) + write_varint(len(codes)) + write_varint(len(leaves))
        if len(leaves):
            out += _encode_tree(leaves, bits) + encode_duplicates(extra)
        out += checksum.crc32(codes.astype("<i8", copy=False)).to_bytes(4, "little")
        return check_written(len(codes), out, self.max_points)

    def decode(self, data: bytes) -> np.ndarray:
        """[N,3] int64 in Morton order. Raises BitstreamError, in time and memory bounded by `max_points`."""
        reader = ByteReader(data)
        version, bits = reader.integer(1), reader.integer(1)
        if version != VERSION:
            raise BitstreamError(f"octree of version {version} is not known: upgrade sw-codecs")
        if not 1 <= bits <= morton.MAX_BITS:
            raise BitstreamError(f"{bits} bits an axis, must be 1..{morton.MAX_BITS}")
        count = reader.varint(point_limit(len(data), self.max_points))
        distinct = reader.varint(count)
        if (count == 0) != (distinct == 0):
            raise BitstreamError(f"{count:,} points, but {distinct:,} distinct ones")
        codes = np.empty(0, np.int64)
        if distinct:
            leaves = _decode_tree(reader, bits, distinct)
            codes = np.repeat(leaves, decode_duplicates(reader, count, distinct))
        crc = reader.integer(4)
        reader.finish()
        if checksum.crc32(codes.astype("<i8", copy=False)) != crc:
            raise BitstreamError("the decoded points do not match their CRC-32")
        return morton.decode(codes)


def _encode_tree(leaves: np.ndarray, bits: int) -> bytes:
    writer, chooser, actions = SymbolWriter(), _TableChooser(), []
    nodes, depth = np.zeros(1, np.int64), 0
    contexts = np.zeros(1, np.int64)  # the root counts as an only child
    while depth < bits and len(nodes) < len(leaves):
        path = leaves >> (3 * (bits - depth - 1))
        children = path[np.diff(path, prepend=-1) != 0]
        parent = np.searchsorted(nodes, children >> 3)
        occupancy = np.bincount(parent, 1 << (children & 7), minlength=len(nodes)).astype(np.int64)
        action, tables = chooser.choose(occupancy - 1, contexts)
        actions.append(action)
        writer.put(occupancy - 1, Tables(tables, contexts))
        contexts = (np.minimum(_POPCOUNT[occupancy], CONTEXTS) - 1)[parent]
        nodes, depth = children, depth + 1
    words, suffix = writer.finish(), 3 * (bits - depth)
    return b"".join(
        [
            bytes([depth, *actions]),
            pack_tables(chooser.stored),
            write_varint(len(words)) + words + writer.crc.to_bytes(4, "little"),
            pack_fixed((leaves & ((1 << suffix) - 1)).astype(np.uint64), suffix),
        ]
    )


def _decode_tree(reader: ByteReader, bits: int, distinct: int) -> np.ndarray:
    depth = reader.integer(1)
    if depth > bits:
        raise BitstreamError(f"{depth} levels, but only {bits} bits an axis")
    actions = bytes(reader.take(depth))
    wanted = [(level, c) for level in range(depth) for c in range(CONTEXTS) if _action(actions[level], c) == OWN]
    stored = dict(zip(wanted, unpack_tables(reader, [OCCUPANCIES] * len(wanted)), strict=True))
    words = reader.take(reader.varint(reader.left))
    levels = np.ones((depth, CONTEXTS, OCCUPANCIES), np.int64)
    for level in range(depth):
        for c in range(CONTEXTS):
            action = _action(actions[level], c)
            if action == OWN:
                levels[level, c] = stored[level, c]
            elif action == LATEST and level:
                levels[level, c] = levels[level - 1, c]
    if not levels.any(axis=2).all():
        raise BitstreamError("a count table is empty")
    nodes = _decode_levels(words, levels, reader.integer(4), distinct)
    if len(nodes) != distinct:
        raise BitstreamError(f"{len(nodes):,} points were found, {distinct:,} were announced")
    suffix = 3 * (bits - depth)
    raw = unpack_fixed(reader.take(packed_size(distinct, suffix)), distinct, suffix)
    return (nodes << suffix) | raw.view(np.int64)


def _decode_levels(words: memoryview, tables: np.ndarray, crc: int, limit: int) -> np.ndarray:
    """Nodes int64 below the last level; `tables` [levels, 4, 255] counts, `limit` the most nodes of a level."""
    if len(words) % 4 == 0 and has_exact():
        coded = torch.from_numpy(np.frombuffer(words, np.uint8).copy())
        nodes, occupancies, sizes, status = exact_operations.decode_octree(coded, torch.from_numpy(tables), limit)
        if status == BEYOND_LIMIT:
            _refuse_nodes(int((sizes > 0).sum()) - 1, limit)
        counts = sizes.tolist()
        found, seen = occupancies[: sum(counts[:-1])].numpy(), 0
        for level in np.split(found, np.cumsum(counts[:-2])):
            seen = checksum.crc32(level.astype("<i4") - 1, seen)
        if status or seen != crc:
            raise BitstreamError(CRC_DIFFERS)
        points: np.ndarray = nodes[: counts[-1]].numpy()
        return points
    reader = SymbolReader(words)
    at, contexts = np.zeros(1, np.int64), np.zeros(1, np.int64)
    for level, counts in enumerate(tables):
        occupancy = reader.get(len(at), Tables(counts, contexts)) + 1
        children = _POPCOUNT[occupancy]
        if children.sum() > limit:
            _refuse_nodes(level, limit)
        place = np.flatnonzero(_CHILDREN[occupancy])  # in [nodes, 8]: several times as fast as two indices
        row = place >> 3
        at = (at[row] << 3) | (place & 7)
        contexts = (np.minimum(children, CONTEXTS) - 1)[row]
    reader.check(crc)
    return at


def _refuse_nodes(level: int, limit: int) -> NoReturn:
    raise BitstreamError(f"level {level} has more nodes than the {limit:,} points that were announced")


class _TableChooser:
    """Picks for each level and context what is cheapest: equal counts, a table of its own, or the latest one."""

    def __init__(self) -> None:
        self.tables = np.ones((CONTEXTS, OCCUPANCIES), np.int64)
        self.stored: list[np.ndarray] = []

    def choose(self, symbols: np.ndarray, contexts: np.ndarray) -> tuple[int, np.ndarray]:
        """The action byte of a level, two bits a context, and the tables [4, 255] to code it with."""
        actions = 0
        histograms = np.bincount(contexts * OCCUPANCIES + symbols, minlength=CONTEXTS * OCCUPANCIES)
        for c, histogram in enumerate(histograms.reshape(CONTEXTS, OCCUPANCIES)):
            if not histogram.any():
                actions |= LATEST << (2 * c)
                continue
            codes = count_codes(histogram)
            options = {UNIFORM: np.ones(OCCUPANCIES, np.int64), OWN: code_counts(codes), LATEST: self.tables[c].copy()}
            costs = {action: _bits(histogram, table) for action, table in options.items()}
            costs[OWN] += table_bits(codes)
            action = min(costs, key=lambda a: (costs[a], a))
            actions |= action << (2 * c)
            self.tables[c] = options[action]
            if action == OWN:
                self.stored.append(histogram)
        return actions, self.tables


def _action(actions: int, context: int) -> int:
    return (actions >> (2 * context)) & 3


def _bits(histogram: np.ndarray, table: np.ndarray) -> float:
    """Cost of coding the symbols that `histogram` counts with `table`."""
    used = histogram > 0
    if (table > 0).sum() == 1 and (used & (table == 0)).any():
        return float("inf")  # a table with a single symbol can code nothing else
    return float((histogram[used] * -np.log2(np.maximum(table[used] / table.sum(), 2.0**-24))).sum())
