"""Sequences of frames: which files they are, and one row for all of them.

Every frame is coded alone, so nothing here says anything about coding between frames.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from splatwizard_core.api import UserInputError
from sw_bench.gsc.tables import PARTS, Row, summary

FPS = 30.0  # of every sequence of the exploration


def frame_files(pattern: str) -> list[Path]:
    """Files that `pattern` names, in the order of their numbers: "f%04d.ply", with one %d in the file's name.

    Raises UserInputError where there is none, or a number between the first and the last is missing.
    """
    path = Path(pattern)
    place = re.fullmatch(r"([^%]*)%(0?\d?)d([^%]*)", path.name)
    if place is None:
        raise UserInputError(f"--frames {pattern}: give one %d, or %04d, in the name of the file: 'f%04d.ply'")
    named = re.compile(f"{re.escape(place[1])}(\\d{{1,9}}){re.escape(place[3])}")
    names = [found for file in path.parent.glob("*") if (found := named.fullmatch(file.name)) is not None]
    numbers = sorted(number for found in names if path.name % (number := int(found[1])) == found[0])
    if not numbers:
        raise UserInputError(f"--frames {pattern}: there is no such file")
    if len(missing := set(range(numbers[0], numbers[-1] + 1)) - set(numbers)):
        raise UserInputError(f"--frames {pattern}: frame {min(missing)} is missing")
    return [path.parent / (path.name % number) for number in numbers]


def sequence_of(pattern: str) -> str:
    """Name of a sequence: that of its files without the number, or of their folder."""
    stem = re.sub(r"%0?\d?d", "", Path(pattern).name.partition(".")[0]).strip("-_")
    return stem if len(stem) > 1 else Path(pattern).resolve().parent.name


def joined(sequence: str, rows: Sequence[Row]) -> Row:
    """One row for the frames' rows of one codec at one rate: bytes add up, scores are over all views of all frames."""
    first = rows[0]
    protocols = [row["protocol"] for row in rows]
    found: Row = {
        "sequence": sequence, "codec": first["codec"], "rate": first["rate"], "frames": len(rows),
        "protocol": joined_protocol(protocols), "splats_source": sum(row["splats_source"] for row in rows),
        "flags": " ".join(sorted({flag for row in rows for flag in row["flags"].split()})),
        **dict.fromkeys(("bytes", "infinite_views")),
    }  # fmt: skip
    failed = [(i, row) for i, row in enumerate(rows) if row["bytes"] is None]
    if failed:
        number, row = failed[0]
        return found | {"flags": "failed", "reason": f"frame {number + 1} of {len(rows)}: {row.get('reason')}"}
    size = sum(row["bytes"] for row in rows)
    views = [{"frame": i, **view} for i, row in enumerate(rows) for view in row["per_view"]]
    return found | {
        "splats_decoded": sum(row["splats_decoded"] for row in rows), "bytes": size,
        "bits_per_splat": 8 * size / found["splats_source"],
        **{f"bytes_{part}": _sum(rows, f"bytes_{part}") for part in PARTS},
        "kbps": 8 * size * FPS / (1000 * len(rows)),
        **summary(views), "views": first["views"],
        **{name: sum(row[name] for row in rows) for name in ("enc_s", "dec_s")},
        **{name: max(row[name] for row in rows) for name in ("rss_enc_mb", "rss_dec_mb")},
        "per_view": views,
    }  # fmt: skip


def joined_protocol(ids: Sequence[str]) -> str:
    """Id of a sequence: the frames' source hashes hashed together, what they share, ranges that one needs."""
    sources = "\n".join(each.partition("/")[0].removeprefix("gsc-") for each in ids)
    kept, _, _ = ids[0].partition("/range-auto:")
    ranges = {name: None for each in ids for name in filter(None, each.partition("/range-auto:")[2].split("+"))}
    tail = f"/range-auto:{'+'.join(ranges)}" if ranges else ""
    return f"gsc-{hashlib.sha256(sources.encode()).hexdigest()[:8]}/{kept.partition('/')[2]}{tail}"


def _sum(rows: Sequence[Mapping[str, int | None]], name: str) -> int | None:
    values = [row[name] for row in rows]
    return None if None in values else sum(value or 0 for value in values)
