"""A published point beside a measured curve: bytes at its PSNR and PSNR at its bytes, each where the curve reaches it.

Point by point, since a published method has one or two rate points: a BD-rate of two points against five flatters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatwizard_core.tooling import several
from sw_report.rate_distortion import pareto_front


@dataclass(frozen=True)
class CurvePoint:
    """One measured rate point of a method on a scene (or of a mean over scenes), mean over its seeds."""

    rate: str
    bytes: float
    psnr: float


@dataclass(frozen=True)
class AtEqual:
    """A published point against a measured curve.

    bytes       of the curve at the published PSNR; None where it does not reach that
    ratio       these bytes over the published ones; below 1: smaller here
    psnr        of the curve at the published bytes, dB; None where it does not reach those
    gain        this PSNR less the published one, dB; above 0: better here
    why         why `bytes` is None, in words; empty where it is known
    """

    bytes: float | None = None
    ratio: float | None = None
    psnr: float | None = None
    gain: float | None = None
    why: str = ""


def at_equal(curve: Sequence[CurvePoint], psnr: float | None, size: float | None) -> AtEqual:
    """Interpolate a curve at a published point: PSNR against log bytes, straight between neighbouring rate points.

    Points that no larger than another are worse are left out first. Nothing is extrapolated.
    """
    if psnr is None:
        return AtEqual(why="no PSNR is published")
    points = {point.rate: point for point in curve}
    sizes, scores = pareto_front([p.bytes for p in points.values()], [p.psnr for p in points.values()])
    if len(sizes) < 2:
        return AtEqual(why=f"{several(len(points), 'rate point')} measured here, a curve needs two")
    logs = np.log(sizes)
    here = None if size is None or not sizes[0] <= size <= sizes[-1] else float(np.interp(math.log(size), logs, scores))
    gain = None if here is None else here - psnr
    if psnr > scores[-1]:
        return AtEqual(psnr=here, gain=gain, why=f"{psnr - scores[-1]:.2f} dB above what is measured here")
    if psnr < scores[0]:
        return AtEqual(psnr=here, gain=gain, why=f"{scores[0] - psnr:.2f} dB below what is measured here")
    found = float(np.exp(np.interp(psnr, scores, logs)))
    return AtEqual(found, None if size is None else found / size, here, gain)


def overlap(curve: Sequence[CurvePoint], published: Sequence[float]) -> float | None:
    """Share of the wider PSNR range, of curve and published points, that both cover; None below two points of each."""
    scores = [point.psnr for point in curve]
    if min(len(scores), len(published)) < 2:
        return None
    shared = min(max(scores), max(published)) - max(min(scores), min(published))
    widest = max(max(scores) - min(scores), max(published) - min(published))
    return max(shared, 0.0) / widest if widest > 0 else None
