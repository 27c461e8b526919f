"""Limit of the points that a file may claim, so that a few bytes cannot fill a reader's memory with copies of one."""

from __future__ import annotations

from splatwizard_core.api import SplatwizardError

MAX_POINTS = 1 << 26
ALWAYS_ALLOWED = 1 << 16
POINTS_PER_BYTE = 64  # real scenes have under one point a byte; 3 million on a grid of 8 bits an axis about 20


def point_limit(size: int, max_points: int) -> int:
    """The most points that `size` bytes may stand for."""
    return min(max_points, max(ALWAYS_ALLOWED, POINTS_PER_BYTE * size))


def check_written(count: int, data: bytes, max_points: int) -> bytes:
    """`data`, if a reader will accept that it holds `count` points. Raises SplatwizardError otherwise."""
    if count > point_limit(len(data), max_points):
        raise SplatwizardError(
            f"{count:,} points in {len(data):,} bytes: more than a reader accepts (at most {max_points:,}, and at most "
            f"{POINTS_PER_BYTE} a byte above {ALWAYS_ALLOWED:,}); remove duplicates first"
        )
    return data
