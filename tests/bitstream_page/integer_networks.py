"""Chapter 4: Entropy models, section on networks and grids in integers."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from bitstream_page.building_blocks import RangeWords, RansWords, crc_i32
from bitstream_page.entropy_models import ExactTables, centre_and_table, coded_values
from bitstream_page.fields import Bytes, check

PAIRS = ((0, 1), (0, 2), (1, 2))
NEIGHBORS = [(-2, x) for x in range(-2, 3)] + [(-1, x) for x in range(-2, 3)] + [(0, -2), (0, -1)]


def network(
    layers: Sequence[tuple[np.ndarray, np.ndarray]], units: np.ndarray, inputs: np.ndarray, *, leaky: bool = False
) -> np.ndarray:
    """A network in integers; `units` of the outputs of the last layer."""
    a = np.clip(inputs, -(1 << 20), 1 << 20)
    for i, (weight, bias) in enumerate(layers):
        u = units if i == len(layers) - 1 else np.ones(len(bias))
        w = np.rint(weight.astype(np.float64) * u[:, None] * 2.0**12).astype(np.int64)
        c = np.rint(bias.astype(np.float64) * u * 2.0**24).astype(np.int64)
        a = (a @ w.T + c) >> 12
        if i < len(layers) - 1:
            a = np.clip(np.where(a < 0, 41 * a >> 12, a), -(1 << 20), 1 << 20) if leaky else np.clip(a, 0, 1 << 20)
    return a


def hash_grid(bits: Iterator[int], levels: Sequence[int], limit: int, signs: int, codes: np.ndarray) -> np.ndarray:
    """Outputs of a binary hash grid for `codes` [n,d]; takes its signs from `bits`."""
    d, found = codes.shape[1], []
    for r in levels:
        size = -(-min(1 << limit, r**d) // 8) * 8
        table = [[2 * next(bits) - 1 for _ in range(signs)] for _ in range(size)]
        for row, code in enumerate(codes.tolist()):
            places = [v * (r - 2) * 4096 // 65535 + 2048 for v in code]
            total, sums = 0, [0] * signs
            for corner in range(1 << d):
                ends = [(t >> 12) + (corner >> axis & 1) for axis, t in enumerate(places)]
                w = 1
                for axis, (t, p) in enumerate(zip(places, ends, strict=True)):
                    w *= 0 if p in (0, r - 1) else t % 4096 if corner >> axis & 1 else 4096 - t % 4096
                if w == 0:
                    continue
                if r**d <= size:
                    entry = sum(p * r**axis for axis, p in enumerate(ends))
                else:
                    entry = 0
                    for p, prime in zip(ends, (1, 2654435761, 805459861), strict=False):
                        entry ^= p * prime % 2**32
                    entry %= size
                total += w
                sums = [s + w * sign for s, sign in zip(sums, table[entry], strict=True)]
            found.append((row, [4096 * s // total if total else 0 for s in sums]))
    n = len(codes)
    return np.array([[x for _, out in found[row::n] for x in out] for row in range(n)], np.int64).reshape(n, -1)


def places(frame: np.ndarray, bounds: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Where 16-bit codes [n,3] on the lattice `bounds` [2,3] lie in a triplane."""
    mu, v, s, low, high = frame[0], frame[1:4], frame[4], frame[5], frame[6]
    o, d = bounds[0], np.where(bounds[1] > bounds[0], (bounds[1] - bounds[0]) / 65535, 1e-6)
    axes = []
    for i in range(3):
        a = [float(v[j, i] * d[j] / s[i]) for j in range(3)]
        z = float((v[0, i] * (o[0] - mu[0]) + v[1, i] * (o[1] - mu[1]) + v[2, i] * (o[2] - mu[2])) / s[i])
        size = ((abs(a[0]) + abs(a[1]) + abs(a[2])) * 2.0**16 + abs(z)) * 2.0**16
        check(size < 2.0**61, "frame")
        e = next(e for e in (20, 16, 12, 8, 4, 0) if size * 2.0**e < 2.0**61)
        axes.append([*(round(x * 2.0 ** (16 + e)) for x in (*a, z)), e])
    sides = [(round(float(a) * 2**18), round(float(b) * 2**18)) for a, b in zip(low, high, strict=True)]
    found = []
    for code in codes.tolist():
        y = [(a * code[0] + b * code[1] + c * code[2] + z) >> e for a, b, c, z, e in axes]
        y = [min(max(each, -(1 << 26)), 1 << 26) for each in y]
        n = math.isqrt(sum(each * each for each in y))
        if n > 1 << 16:
            y = [(((2 * n - (1 << 16)) << 16) // n) * each // n for each in y]
        u = [((p + (1 << 17) - low_) << 20) // max(high_ - low_, 1) for p, (low_, high_) in zip(y, sides, strict=True)]
        found.append([min(max(each, 0), 1 << 20) for each in u])
    return np.array(found, np.int64).reshape(-1, 3)


def triplane(scales: Sequence[np.ndarray], u: np.ndarray) -> np.ndarray:
    """Outputs at places [n,3] of planes [3,C,R,R] a scale."""
    sums, found = 0, []
    for planes in scales:
        r = planes.shape[-1]
        t = u * (r - 1) >> 8
        c = np.minimum(t >> 12, max(r - 2, 0))
        f = t - 4096 * c
        ends, weights = np.stack([c, np.minimum(c + 1, r - 1)]), np.stack([4096 - f, f])
        samples = [
            sum(
                weights[i, :, a] * weights[j, :, b] * plane[:, ends[j, :, b], ends[i, :, a]]
                for i in (0, 1)
                for j in (0, 1)
            )
            for (a, b), plane in zip(PAIRS, planes, strict=True)
        ]
        sums = sums + np.concatenate(samples)
        found.append(sums >> 16)
    return np.concatenate(found).T


def expected(plane: np.ndarray, model: Any, row: int, column: int) -> tuple[int, int]:
    """I and the number of the table of an integer, from its neighbours in a plane [H,W]."""
    around = [(row + y, column + x) for y, x in NEIGHBORS]
    inside = [0 <= y < plane.shape[0] and 0 <= x < plane.shape[1] for y, x in around]
    seen = [int(plane[at]) if ok else 0 for at, ok in zip(around, inside, strict=True)]
    mu, t = network(model, np.ones(2), np.array([seen], np.int64) * 4096)[0].tolist()
    level = min(max((7_215_259_165 - 288_539 * t) >> 28, 0), 63)
    return centre_and_table(mu, level, 4096)


def planes_under_models(
    section: bytes, tables: ExactTables, shapes: Sequence[tuple[int, ...]], models: Sequence[Any]
) -> list[np.ndarray]:
    file = Bytes(section)
    version, crc_of_tables = file.unpack("HI")
    check(version in (1, 2) and crc_of_tables == tables.crc, "other tables")
    found = [np.zeros(shape, np.int64) for shape in shapes]
    read = plane_streams if version == 2 else single_stream
    read(file, tables, found, models)
    return found


def plane_streams(file: Bytes, tables: ExactTables, found: list[np.ndarray], models: Sequence[Any]) -> None:
    """Version 2, into `found`."""
    crc, g = file.one("I"), file.varint()
    streams = [
        (plane[k, first : first + g], models[k])
        for plane in found
        if plane.size
        for k in range(len(models))
        for first in range(0, plane.shape[1], g)
    ]
    sizes = [(file.varint(), file.varint()) for _ in streams]
    for (channels, model), (length, escapes) in zip(streams, sizes, strict=True):
        words, bits = RansWords(file.take(length)), Bytes(file.take(escapes)).bits()
        _, height, width = channels.shape
        for w in range(width + 3 * (height - 1)):
            for row in range(height):
                if 0 <= w - 3 * row < width:
                    for plane in channels:
                        centre, number = expected(plane, model, row, w - 3 * row)
                        (value,) = coded_values(words, bits, tables, "laplace", [number])
                        plane[row, w - 3 * row] = value + centre
        check(words.state == 0 and not words.words and not any(bit == "1" for bit in bits), "end of a stream")
    file.done()
    check(crc_i32([v for plane in found for v in plane.reshape(-1).tolist()]) == crc, "CRC of planes")


def single_stream(file: Bytes, tables: ExactTables, found: list[np.ndarray], models: Sequence[Any]) -> None:
    """Version 1, into `found`."""
    crc, escapes, length = file.one("I"), file.varint(), file.varint()
    words, bits, coded = RangeWords(file.take(length)), file.bits(), []
    for w in range(max(plane.shape[3] + 3 * (plane.shape[2] - 1) for plane in found)):
        due = [
            (scale, k, c, row, w - 3 * row)
            for scale, plane in enumerate(found)
            for k, c, row in itertools.product(*(range(length_) for length_ in plane.shape[:3]))
            if 0 <= w - 3 * row < plane.shape[3]
        ]
        parameters = [expected(found[scale][k, c], models[k], row, column) for scale, k, c, row, column in due]
        numbers = [number for _, number in parameters]
        values = coded_values(words, bits, tables, "laplace", numbers)
        escapes -= sum(abs(s) > tables.radius["laplace"][n // 8] for s, n in zip(values, numbers, strict=True))
        for (scale, *at), value, (centre, _) in zip(due, values, parameters, strict=True):
            found[scale][tuple(at)] = value + centre
            coded.append(value + centre)
    check(escapes == 0 and crc_i32(coded) == crc, "CRC of planes")
