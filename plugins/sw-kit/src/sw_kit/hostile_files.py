"""Makes hostile .swz files out of good ones, and looks at what a decoder does with them.

Damage alone is caught by the checksums, so most mutations repair them: a changed section gets its CRC-32 in the header,
a changed header its own.
"""

from __future__ import annotations

import copy
import json
import struct
import time
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splatwizard_core.api import BitstreamError, PluginError
from splatwizard_core.tooling import peak_rss_bytes, reset_peak_rss, rss_bytes

INTEGERS = (
    0, 1, 2, 3, 7, 127, 128, 255, 256, 4095, 4096, 65_535, 65_536, 2**20, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**60,
    2**61 + 2, 2**62, 2**63 - 1, 2**64 - 1,
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    *INTEGERS, -1, -(2**31), 0.0, 0.5, -1.5, 1e-300, 1e300, 3.5e38, True, None, "", "x", [], {}, [0] * 3, [1e38] * 3,
    {"a": [1]},
)  # fmt: skip


@dataclass
class Parts:
    """A file taken apart: prefix, header, sections in order."""

    header: dict[str, Any]
    sections: list[tuple[str, bytes]]

    @classmethod
    def of(cls, data: bytes) -> Parts:
        (length,) = struct.unpack_from("<I", data, 6)
        header = json.loads(data[10 : 10 + length])
        body = data[14 + length :]
        sections = [(name, body[at : at + size]) for name, at, size, _ in header.pop("sections")]
        return cls(header, sections)

    def table(self) -> list[list[Any]]:
        rows, at = [], 0
        for name, content in self.sections:
            rows.append([name, at, len(content), zlib.crc32(content)])
            at += len(content)
        return rows

    def true_cuts(self) -> Any:
        """The cuts of the header with the lengths that the sections have now; as they are where they make no sense."""
        rows = self.header["cuts"]
        try:
            counts = [*(int(row[0]) for row in rows[:-1]), len(self.sections)]
            ends = [sum(len(content) for _, content in self.sections[:n]) for n in counts]
            return [[n, end, row[2]] for n, end, row in zip(counts, ends, rows, strict=True)]
        except (TypeError, ValueError, LookupError, OverflowError):
            return rows

    def join(self, table: list[Any] | None = None, raw: Callable[[bytes], bytes] = bytes) -> bytes:
        """The file with right checksums. table: instead of the true section table; raw: changes the header's bytes."""
        told = {**self.header, "sections": self.table() if table is None else table}
        if "cuts" in told and table is None:
            told["cuts"] = self.true_cuts()
        header = raw(json.dumps(told).encode())
        prefix = struct.pack("<4sHI", b"SPWZ", 2 if "cuts" in self.header else 1, len(header))
        return b"".join([prefix, header, struct.pack("<I", zlib.crc32(header)), *(s for _, s in self.sections)])


class Mutator:
    """Draws hostile files from good ones, always the same ones for a seed."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def below(self, n: int) -> int:
        return int(self.rng.integers(n)) if n > 0 else 0

    def pick(self, items: Any) -> Any:
        return items[self.below(len(items))]

    def bytes_(self, data: bytes, other: bytes = b"") -> bytes:
        """A few changes anywhere in a byte string."""
        changed = bytearray(data)
        for _ in range(self.pick((1, 1, 1, 2, 4, 16))):
            at = self.below(len(changed) + 1)
            what = self.below(9)
            if what == 0 and at < len(changed):
                changed[at] ^= 1 << self.below(8)
            elif what == 1 and at < len(changed):
                changed[at] = self.pick((0, 1, 2, 0x7F, 0x80, 0xFE, 0xFF, self.below(256)))
            elif what == 2:
                del changed[at:]
            elif what == 3:
                changed[at:at] = self.rng.bytes(self.pick((1, 1, 2, 4, 30)))
            elif what == 4:
                del changed[at : at + self.pick((1, 1, 2, 4, 30))]
            elif what == 5:
                value = self.pick(INTEGERS) & 0xFFFFFFFF
                changed[at : at + 4] = struct.pack("<I", value)
            elif what == 6:
                changed[at : at + 1] = varint(self.pick(INTEGERS) + self.below(3))
            elif what == 7 and other:
                start = self.below(len(other))
                size = self.pick((1, 4, 16, 200))
                changed[at : at + size] = other[start : start + size]
            elif what == 8:
                changed[at : at + 8] = bytes([self.pick((0, 0xFF))]) * 8
        return bytes(changed)

    def value(self, old: Any) -> Any:
        """Something else in place of a JSON value."""
        if isinstance(old, list) and old and self.below(2):
            changed = copy.deepcopy(old)
            changed[self.below(len(old))] = self.value(self.pick(old))
            return changed
        if isinstance(old, (int, float)) and not isinstance(old, bool) and self.below(2):
            return self.pick((old + 1, old - 1, old * 2, -old, old * 1000, old / 1000, float(old)))
        return copy.deepcopy(self.pick(VALUES))

    def cuts(self, parts: Parts) -> bytes:
        """A file whose cuts may be wrong, and that ends at one of them or anywhere."""
        table = parts.table()
        rows = [[n + 1, at + size, None] for n, (_, at, size, _) in enumerate(table) if size and self.below(2)]
        rows = parts.true_cuts() if "cuts" in parts.header else rows
        for _ in range(self.pick((0, 1, 1, 2))):
            what, row = self.below(5), self.pick(rows) if rows else []
            if what == 0:
                rows.insert(self.below(len(rows) + 1), self.value(row))
            elif what == 1:
                rows.insert(self.below(len(rows) + 1), copy.deepcopy(row))
            elif what == 2 and rows:
                del rows[self.below(len(rows))]
            elif what == 3:
                rows += [[n, n, None] for n in range(self.pick((1, 5000)))]
            elif isinstance(row, list) and len(row) == 3:
                row[self.below(3)] = self.value(self.pick(row))
        data = Parts({**parts.header, "cuts": rows}, parts.sections).join(table)
        start = len(data) - sum(len(content) for _, content in parts.sections)
        ends = [start + at + size for _, at, size, _ in table] or [start]
        return data[: self.pick(ends) if self.below(4) else self.below(len(data) + 1)]

    def entries(self, mapping: dict[str, Any]) -> None:
        """Change, remove or add an entry of a JSON object."""
        what = self.below(6)
        if what == 0 and mapping:
            del mapping[self.pick(list(mapping))]
        elif what == 1:
            mapping[self.pick(("surprise", "mode", "", "a" * 300))] = self.pick(VALUES)
        elif mapping:
            key = self.pick(list(mapping))
            if isinstance(mapping[key], dict) and self.below(2):
                self.entries(mapping[key])
            else:
                mapping[key] = self.value(mapping[key])

    def file(self, seeds: list[bytes]) -> tuple[bytes, str]:
        """A hostile file, and the name of what was done."""
        data = self.pick(seeds)
        kind = self.pick(KINDS)
        if kind == "damage":
            return self.bytes_(data, self.pick(seeds)), kind
        parts, other = Parts.of(data), Parts.of(self.pick(seeds))
        sections = parts.sections
        if kind == "cuts":
            return self.cuts(parts), kind
        if kind == "header bytes":
            return parts.join(raw=lambda raw: self.bytes_(raw)), kind
        if kind == "header values":
            for _ in range(self.pick((1, 1, 2, 3))):
                static = parts.header.get("static")
                self.entries(static if isinstance(static, dict) and self.below(3) else parts.header)
        elif kind == "table" and sections:
            table = parts.table()
            for _ in range(self.pick((1, 2))):
                row = self.pick(table)
                row[self.below(4)] = self.value(self.pick(row))
            return parts.join(table), kind
        elif kind == "sections" and sections:
            for _ in range(self.pick((1, 1, 2))):
                self.rearrange(sections, other)
        elif sections:
            for _ in range(self.pick((1, 1, 1, 2))):
                at = self.below(len(sections))
                name, content = sections[at]
                splice = self.pick(other.sections)[1] if other.sections else b""
                sections[at] = (name, self.bytes_(content, splice))
            if self.below(8) == 0:
                self.entries(parts.header["static"])
        return parts.join(), kind

    def rearrange(self, sections: list[tuple[str, bytes]], other: Parts) -> None:
        """Swap, drop, copy, rename sections, or take one of another file."""
        i, j = self.below(len(sections)), self.below(len(sections))
        what = self.below(6)
        if not sections:
            return
        if what == 0:
            (a, x), (b, y) = sections[i], sections[j]
            sections[i], sections[j] = (a, y), (b, x)
        elif what == 1:
            sections[i], sections[j] = sections[j], sections[i]
        elif what == 2:
            del sections[i]
        elif what == 3:
            sections.append((self.pick(("extra", sections[i][0], "sh3", "means")), sections[j][1]))
        elif what == 4:
            sections[i] = (sections[j][0] + self.pick(("", "x")), sections[i][1])
        elif other.sections:
            sections[i] = (sections[i][0], self.pick(other.sections)[1])


KINDS = ("damage", "header bytes", "header values", "header values", "table", "sections", "cuts", *("content",) * 5)


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


@dataclass
class Tally:
    """Outcomes of decoding a number of files."""

    outcomes: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    largest_growth: int = 0
    worst_ratio: float = 0.0
    problems: list[str] = field(default_factory=list)


PATIENCE = 60.0
"""CPU seconds that a file may take: the slowest takes 0.3, so what takes as long hangs, on any machine."""


def attempt(
    decode: Callable[[], str],
    label: str,
    limit: int,
    tally: Tally,
    *,
    plugins_may_miss: bool = False,
) -> None:
    """Run `decode() -> outcome`; count the outcome, and note as problems what must not be.

    limit       bytes by which the resident set may grow
    """
    before = rss_bytes() if reset_peak_rss() else None
    began = time.process_time()
    try:
        outcome = decode()
    except BitstreamError as error:
        outcome = "refused"
        if "\n" in str(error) or len(str(error)) > 1000:
            tally.problems.append(f"{label}: a message of {len(str(error))} characters")
    except PluginError as error:
        outcome = "needs a plugin"
        if not plugins_may_miss:
            tally.problems.append(f"{label}: PluginError: {error}")
    except BaseException as error:
        outcome = "problem"
        tally.problems.append(f"{label}: {type(error).__name__}: {error}")
        if isinstance(error, (KeyboardInterrupt, SystemExit)):
            raise
    took = time.process_time() - began
    tally.outcomes[outcome] += 1
    tally.slowest_s = max(tally.slowest_s, took)
    if took > PATIENCE:
        tally.problems.append(f"{label}: {took:.2f} s")
    if before is not None:
        growth = peak_rss_bytes() - before
        tally.largest_growth = max(tally.largest_growth, growth)
        tally.worst_ratio = max(tally.worst_ratio, growth / limit)
        if growth > limit:
            tally.problems.append(f"{label}: {growth:,} bytes, allowed are {limit:,}")
