"""Declared cuts: the lengths at which a file may end and be a whole, shorter one.

A progressive method writes its sections in packets, each of which builds on those before it alone, and declares a cut
after each (`ContainerWriter.cut`). A file that ends at a cut is read like any other; one that ends elsewhere is
truncated. Container version 2, in docs/bitstream.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from splatwizard_core.base.warned import warn_once
from splatwizard_core.errors import UserInputError


class Cut(NamedTuple):
    """The end of a packet.

    sections    number of sections up to it
    bytes       of those sections, without the header
    psnr        mean of the training views at this cut, dB; None: the encoder did not tell
    """

    sections: int
    bytes: int
    psnr: float | None = None


class Prefix(NamedTuple):
    """The part of a file that is read; by default all that is there.

    packets     so many packets
    bytes       the longest cut of at most so many bytes, header included
    partial     of a file that ends at no cut or is damaged, as of a broken download, the longest cut that is whole
    """

    packets: int | None = None
    bytes: int | None = None
    partial: bool = False


WHOLE = Prefix()


def parse_cuts(rows: Any, ends: Sequence[int]) -> list[Cut]:
    """Return the cuts of a header: rows [sections, bytes, psnr or null]. Raises ValueError for what makes no sense.

    ends    bytes of the first 0, 1, 2, ... sections
    """
    if not isinstance(rows, list) or not 0 < len(rows) < len(ends):
        raise ValueError("cuts are no list, or not from one to as many as there are sections")
    cuts = [Cut(0, 0)]
    for row in rows:
        if not isinstance(row, list) or len(row) != 3 or any(type(number) is not int for number in row[:2]):
            raise ValueError("a row of the cuts is not [sections, bytes, psnr]")
        cut = Cut(*row)
        if cut.psnr is not None and not (type(cut.psnr) in (int, float) and abs(cut.psnr) <= 1000):
            raise ValueError(f"the PSNR of a cut is {cut.psnr!r:.80}")
        if not cuts[-1].sections < cut.sections < len(ends) or cut.bytes <= cuts[-1].bytes:
            raise ValueError("cuts do not grow, or lie beyond the last section")
        if ends[cut.sections] != cut.bytes:
            raise ValueError(f"a cut of {cut.bytes:,} bytes lies inside of a section")
        cuts.append(cut)
    if cuts[-1].sections != len(ends) - 1:
        raise ValueError("the last cut is not the end of the file")
    return cuts[1:]


def chosen_cut(cuts: Sequence[Cut], length: int, header: int, prefix: Prefix, name: str) -> int:
    """Return how many packets are read of a file that has `length` bytes behind a header of so many.

    Raises ValueError if the file ends at no cut, UserInputError if it does not hold what `prefix` asks for.
    """
    there = sum(cut.bytes <= length for cut in cuts)
    ends = [header + cut.bytes for cut in cuts]
    if not (prefix.partial and there) and length not in [cut.bytes for cut in cuts]:
        advice = f"--partial of `sw decode` or `sw truncate` takes packet {there} ({ends[there - 1]:,} bytes)"
        advice = advice if there else f"the first cut is at {ends[0]:,} bytes"
        raise ValueError(f"{header + length:,} bytes end at no declared cut: the file is truncated; {advice}")
    if prefix.partial and (lost := cuts[-1].bytes - length):
        end = f"{lost:,} bytes are missing" if lost > 0 else f"{-lost:,} bytes behind them are left out"
        warn_once(f"{name}: {there} of {len(cuts)} packets are there, {end}")
    if prefix.packets is not None and prefix.packets > there:
        raise UserInputError(f"{name}: it has {there} packets, {prefix.packets} are asked for")
    fits = there if prefix.bytes is None else sum(end <= prefix.bytes for end in ends[:there])
    found = fits if prefix.packets is None else min(fits, prefix.packets)
    if found < 1:
        raise UserInputError(f"{name}: its first packet ends at {ends[0]:,} bytes, less is no scene")
    return found
