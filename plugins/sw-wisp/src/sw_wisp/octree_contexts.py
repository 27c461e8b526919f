"""Contexts of the bits of `leaf-octree`, and the probabilities that a file stores for them.

Whether child 0 to 7 of a node is occupied depends on the cells that share a face with it. Along an axis on which the
child lies on the far side, its sibling and the child of the next node are coded before it and known; on the near side
the next node is all that is known. So there are, for each number of far sides, the occupied of those cells and whether
a child of the node is occupied yet; all that times the splats of earlier subsets in the child, 0, 1 or more.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader, pack_fixed, packed_size, unpack_fixed
from sw_wisp.nested import UNIT
from sw_wisp.numbers import HIGHEST_LEVEL, LOWEST_LEVEL

CLASSES = 3
FAR = np.array([child.bit_count() for child in range(8)])
"""Far sides of each child."""
FIRST = np.cumsum([0, *((2 * far + 1) * (4 - far) * 2 for far in range(4))])
"""[5] where the contexts of each number of far sides begin, in each class; the last is how many there are."""
ENDS = CLASSES * int(FIRST[-1])
MORE, ON = ENDS + CLASSES, ENDS + CLASSES + 1
"""Contexts of one level: child bits; "a splat ends here" by class; "another one ends here"; "it also goes on"."""
CONTEXTS = ON + 1
KINDS = np.repeat(np.arange(4), [ENDS, MORE - ENDS, 1, 1])  # [CONTEXTS]
LEVELS = HIGHEST_LEVEL - LOWEST_LEVEL + 1
SEEN_ENOUGH = 32
"""Bits that a context must have had to get a probability of its own."""
BITS_OF_A_SHARE = 12
AXES = 0x1249249249249249
"""Bits of x in a Morton code."""


class Around:
    """The nodes of one level of the octree, and the cells around their children.

    nodes   [M] int64, ascending Morton codes at `level`
    bits    [M,8] bool: which children are occupied, to be filled in child by child
    """

    def __init__(self, nodes: np.ndarray, level: int) -> None:
        self._bits = np.zeros((len(nodes) + 1, 8), bool)  # the last row: where there is no node
        self.bits = self._bits[:-1]
        self._next = [[_neighbours(nodes, level, axis, far) for far in range(2)] for axis in range(3)]

    def contexts(self, child: int, classes: np.ndarray) -> np.ndarray:
        """Contexts int64 [M] of the bit of a child, those of lower number being there; `classes` [M] of the child."""
        missing = len(self.bits)
        known, near = np.zeros(missing, np.int64), np.zeros(missing, np.int64)
        for axis in range(3):
            beside = self._next[axis][child >> axis & 1]
            if child >> axis & 1:
                sibling = child ^ 1 << axis
                known += self.bits[:, sibling]
                known += self._bits[beside, sibling]
            else:
                near += beside < missing
        far = int(FAR[child])
        found: np.ndarray = (known * (4 - far) + near) * 2 + self.bits[:, :child].any(1)
        return found + FIRST[far] + classes * FIRST[-1]


def _neighbours(nodes: np.ndarray, level: int, axis: int, far: int) -> np.ndarray:
    """Place among `nodes` of the one behind each along an axis, on its near or far side; M where there is none."""
    mask = AXES << axis & (1 << 3 * level) - 1
    own, rest = nodes & mask, nodes & ~mask
    step = ((own | ~mask) + 1 if far else own - 1) & mask
    is_inside = own != (mask if far else 0)
    place = np.searchsorted(nodes, step | rest)
    found = np.minimum(place, max(len(nodes) - 1, 0))
    return np.where(is_inside & (nodes[found] == step | rest), found, len(nodes))


@dataclass(frozen=True)
class Shares:
    """Probabilities of a 1 by level and context, times 4096.

    shared  [16, 4] int64 in 1..4095, by level and kind (child bits, ends, more, on)
    common  [180] int64 in 0..4095, of contexts of child bits at all levels; 0: as `shared`
    single  [16, 183] int64 in 0..4095, of contexts of one level that have their own; 0: as `common`, else as `shared`
    """

    shared: np.ndarray
    common: np.ndarray
    single: np.ndarray

    @classmethod
    def fitted(cls, counts: np.ndarray) -> Shares:
        """From counts [16 * CONTEXTS, 2] of zeros and ones; a context gets what it saves the bits of storing."""
        table = counts.reshape(LEVELS, CONTEXTS, 2)
        shared = _share(np.stack([table[:, kind == KINDS].sum(1) for kind in range(4)], axis=1))
        table = table[:, :MORE]
        found = cls(shared, np.zeros(ENDS, np.int64), np.zeros((LEVELS, MORE), np.int64))
        children = table[:, :ENDS]
        own = _share(children.sum(0))
        saved = (_bits(children, shared[:, :1]) - _bits(children, own)).sum(0)
        found.common[:] = np.where(saved > BITS_OF_A_SHARE, own, 0)
        own = _share(table)
        saved = _bits(table, found.table[:, :MORE]) - _bits(table, own)
        found.single[:] = np.where((table.sum(2) >= SEEN_ENOUGH) & (saved > BITS_OF_A_SHARE), own, 0)
        return found

    @property
    def table(self) -> np.ndarray:
        """[16, CONTEXTS] int64 in 1..4095."""
        table = self.shared[:, KINDS]
        table[:, :ENDS] = np.where(self.common > 0, self.common, table[:, :ENDS])
        table[:, :MORE] = np.where(self.single > 0, self.single, table[:, :MORE])
        return table

    @functools.cached_property
    def ones(self) -> np.ndarray:
        """[16 * CONTEXTS] int64 in 1..4095."""
        return self.table.reshape(-1)

    def pack(self) -> bytes:
        """First and last level that has bits, and classes; probabilities of these, each kind after its flags."""
        used = np.flatnonzero((self.shared != UNIT // 2).any(1))
        first, last = (int(used[0]), int(used[-1])) if len(used) else (0, 0)
        rows, later = slice(first, last + 1), FIRST[-1]
        is_later = self.common[later:].any() or self.single[:, later:ENDS].any() or self.single[:, ENDS + 1 :].any()
        classes = CLASSES if is_later else 1
        columns = _of_classes(classes)
        common, single = self.common[columns[columns < ENDS]], self.single[rows][:, columns]
        parts = [
            (self.shared[rows], BITS_OF_A_SHARE),
            (common > 0, 1),
            (common[common > 0], BITS_OF_A_SHARE),
            (single > 0, 1),
            (single[single > 0], BITS_OF_A_SHARE),
        ]
        packed = (pack_fixed(np.asarray(p).reshape(-1).astype(np.uint64), width) for p, width in parts)
        return bytes([first, last, classes]) + b"".join(packed)

    @classmethod
    def unpack(cls, reader: ByteReader) -> Shares:
        """Inverse of `pack`. Raises BitstreamError."""
        first, last, classes = reader.integer(1), reader.integer(1), reader.integer(1)
        if not first <= last < LEVELS:
            raise BitstreamError(f"the octree is said to have levels {first}..{last} of {LEVELS}")
        if classes not in (1, CLASSES):
            raise BitstreamError(f"the octree is said to have {classes} classes of cells")
        levels, columns = np.arange(first, last + 1), _of_classes(classes)
        found = cls(np.full((LEVELS, 4), UNIT // 2), np.zeros(ENDS, np.int64), np.zeros((LEVELS, MORE), np.int64))
        found.shared[levels] = _unpacked(reader, 4 * len(levels), BITS_OF_A_SHARE).reshape(-1, 4)
        children = columns[columns < ENDS]
        common = _flagged(reader, len(children))
        single = _flagged(reader, len(levels) * len(columns))
        found.common[children] = common
        found.single[np.ix_(levels, columns)] = single.reshape(len(levels), -1)
        if found.shared.min() < 1:
            raise BitstreamError("a probability of the octree is 0")
        return found


def _of_classes(classes: int) -> np.ndarray:
    """Contexts of a level, but for the last two, of the first so many classes."""
    return np.concatenate([np.arange(classes * FIRST[-1]), ENDS + np.arange(classes)])


def _flagged(reader: ByteReader, count: int) -> np.ndarray:
    """Numbers int64 [count] of which flags say whether they are 0."""
    is_there = _unpacked(reader, count, 1) == 1
    found = np.zeros(count, np.int64)
    found[is_there] = _unpacked(reader, int(is_there.sum()), BITS_OF_A_SHARE)
    if (found[is_there] < 1).any():
        raise BitstreamError("a probability of the octree is 0")
    return found


def _share(counts: np.ndarray) -> np.ndarray:
    """4096 times the share of ones, int64 [...] in 1..4095, for counts [..., 2]."""
    total = counts.sum(-1)
    share = np.rint(UNIT * counts[..., 1] / np.maximum(total, 1)).astype(np.int64)
    return np.where(total > 0, np.clip(share, 1, UNIT - 1), UNIT // 2)


def _bits(counts: np.ndarray, ones: np.ndarray) -> np.ndarray:
    """Bits float64 [...] of counts [..., 2] under shares of ones [...]."""
    return -counts[..., 1] * np.log2(ones / UNIT) - counts[..., 0] * np.log2(1 - ones / UNIT)


def _unpacked(reader: ByteReader, count: int, width: int) -> np.ndarray:
    return unpack_fixed(reader.take(packed_size(count, width)), count, width).astype(np.int64)
