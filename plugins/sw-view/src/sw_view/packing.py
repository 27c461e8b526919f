"""Explicit Gaussians as the compact bytes that the page unpacks (page/data.js): quantized, ordered, deflated.

A Gaussian takes 19 bytes and 3 a coefficient of the bands above 0, before deflate:

    place       3 x 16 bit, between the bounds of its chunk of 256 neighbours (Morton order)
    rotation    32 bit, smallest three of (w,x,y,z): index of the largest, 3 x 10 bit
    scales      3 x 10 bit, logarithmic; at most `LOG_RANGE` below the largest
    colour      11 + 11 + 10 bit, of 0.5 + SH_C0 dc
    opacity     8 bit
    bands 1-3   8 bit a coefficient, one step a band
"""

from __future__ import annotations

import base64
import sys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sw_gaussians.morton import BITS, interleave
from sw_gaussians.surfels import as_ellipsoids

from splatwizard_core.api import SH_C0, GaussianInputs, GaussianModel, SceneError, SplatModel

CHUNK = 256
LOG_RANGE = 14.0
"""Largest minus least log scale that is told apart: e^-14 of the largest Gaussian is below any pixel."""
LEAST_STEP = 0.008
"""Of a coefficient: a finer one changes no 8-bit colour."""
FAINTEST = 1 / 255
"""Gaussians with less opacity are drawn by no rasterizer."""
FARTHEST = 1e4
"""Distance from the median that is kept along an axis, in widths of the middle half: farther ones coarsen others."""
BRIGHTEST = 8.0
"""Least and largest 0.5 + SH_C0 dc are -8 and 8, of a coefficient, too: a wilder one would coarsen all others."""

Reach = tuple[float, float, float, float]
"""x, y, z of a middle, and how far from it along an axis Gaussians are kept."""


@dataclass(frozen=True)
class Packed:
    """Gaussians for the page: their bytes as text, and the numbers that are needed to unpack them.

    means       [n,3], of those that are kept
    """

    text: str
    facts: dict[str, Any]
    means: NDArray[np.float32]
    reach: Reach
    decoder: str = ""  # elements of the page with which `text` is a .swz (coded_file.py)


def explicit(model: SplatModel) -> GaussianModel:
    """Return the Gaussians of a model, surfels as thin ellipsoids. Raises SceneError if they depend on the camera."""
    if not isinstance(model, GaussianModel):
        raise SceneError(
            f"a {type(model).__name__} has no fixed Gaussians, as the page holds: they depend on the camera; "
            "`sw view FILE --html PAGE.html` writes a page that decodes files of mode exact, `sw bake` fits fixed ones"
        )
    return as_ellipsoids(model)


def solid_means(model: GaussianModel) -> NDArray[np.float32]:
    """Return the means [n,3] of the Gaussians that can be drawn: finite, not too faint, not too far."""
    means: NDArray[np.float32] = model.means[_drawable(model)[0]].detach().float().cpu().numpy()
    return means


@torch.no_grad()
def _drawable(model: GaussianModel) -> tuple[torch.Tensor, Reach]:
    """Return which Gaussians can be drawn, and how far from which middle those are."""
    keep = torch.sigmoid(model.opacity_logits) >= FAINTEST
    for value in (getattr(model, name) for name in model.RAW):
        keep &= torch.isfinite(value).flatten(1).all(dim=1) if value.dim() > 1 else torch.isfinite(value)
    kept = torch.nonzero(keep)[:, 0]
    places = model.means[kept].detach().double().cpu().numpy()
    *middle, reach = found = _reach(places)
    near = (np.abs(places - middle) <= reach).all(axis=1)
    keep[kept[torch.from_numpy(~near).to(kept.device)]] = False
    return keep, found


def _reach(places: NDArray[np.float64]) -> Reach:
    """Return the median of places [N,3] and `FARTHEST` widths of the middle half; where half are one, all are near."""
    if not len(places):
        return 0.0, 0.0, 0.0, sys.float_info.max
    low, middle, high = np.percentile(places, (25, 50, 75), axis=0)
    x, y, z = middle.tolist()
    return x, y, z, FARTHEST * float((high - low).max()) or sys.float_info.max


def pack(model: SplatModel) -> Packed:
    """Quantize, order and deflate the Gaussians of a model, those that are finite, not too faint and not too far.

    Raises SceneError if they depend on the camera, or if none is left.
    """
    found = explicit(model)
    with torch.no_grad():
        keep, reach = _drawable(found)
        means, logits, log_scales, quats = (
            getattr(found, name)[keep].detach().float().cpu().numpy()
            for name in ("means", "opacity_logits", "log_scales", "quats")
        )
        bands = (found.active_sh_degree + 1) ** 2 - 1
        dc = found.sh_dc[keep, 0].detach().float().cpu().numpy()
        rest = found.sh_rest[keep, :bands].detach().float().cpu().numpy()
    if not len(means):
        raise SceneError("the model has no Gaussian that could be drawn, so there is nothing to show")
    order = morton_order(means)
    places, bounds = _places(means[order])
    scales, scale_range = _scales(log_scales[order])
    colors, color_range = _colors(dc[order])
    coefficients, steps = _coefficients(rest[order], found.active_sh_degree)
    opacities = np.round(255 / (1 + np.exp(-logits[order].astype(np.float64)))).astype(np.uint8)
    parts = (bounds, _rotations(quats[order]), colors, scales, *places, opacities, coefficients)
    packed = zlib.compress(b"".join(np.ascontiguousarray(part).tobytes() for part in parts), 9)
    facts = {
        "count": len(means), "chunk": CHUNK, "degree": found.active_sh_degree,
        "scales": scale_range, "colors": color_range, "bands": steps,
    }  # fmt: skip
    return Packed(base64.b64encode(packed).decode("ascii"), facts, means[order], reach)


def ranges_of(seen: Sequence[GaussianInputs]) -> tuple[dict[str, Any], Reach]:
    """Return what the page needs to quantize Gaussians that it computes itself, from those of some places; and a reach.

    Raises SceneError if there is none.
    """
    scales = [each.scales.detach().float().cpu() for each in seen if each.scales is not None and len(each.means)]
    if not scales:
        raise SceneError("none of the cameras sees a Gaussian, so there is nothing to show")
    logs = torch.cat(scales).clamp(min=1e-9).log().numpy()
    low, high = _scale_range(logs[np.isfinite(logs).all(axis=1)])
    means = torch.cat([each.means.detach().double().cpu() for each in seen]).numpy()
    facts = {"degree": 0, "scales": [low, max(high - low, 1e-6) / 1023], "colors": [0.0, 1 / 2047], "bands": []}
    return facts, _reach(means[np.isfinite(means).all(axis=1)])


def morton_order(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return rows so that neighbours [N,3] follow each other: by the interleaved bits of 21-bit coordinates."""
    low, high = means.min(axis=0).astype(np.float64), means.max(axis=0).astype(np.float64)
    least, most = np.percentile(means.astype(np.float64), (1, 99), axis=0, method="nearest")
    low, high = np.maximum(low, 2 * least - most), np.minimum(high, 2 * most - least)  # a far one is at the border
    cells = ((means.clip(low, high) - low) / np.maximum(high - low, 1e-30) * (2**BITS - 1)).astype(np.int64)
    return np.argsort(interleave(cells), kind="stable")


def _places(means: NDArray[np.float32]) -> tuple[list[NDArray[np.uint16]], NDArray[np.float32]]:
    """Return x, y, z as [N] each, and the bounds [chunks,6]: least and largest x, y, z."""
    starts = np.arange(0, len(means), CHUNK)
    low, high = (np.repeat(f.reduceat(means, starts), CHUNK, axis=0)[: len(means)] for f in (np.minimum, np.maximum))
    low, high = low.astype(np.float64), high.astype(np.float64)  # their difference may be no float32
    share = (means - low) / np.maximum(high - low, 1e-30)
    cells = np.round(share * 65535).astype(np.uint16)
    bounds = np.concatenate([low[::CHUNK], high[::CHUNK]], axis=1).astype(np.float32)
    return [cells[:, k] for k in range(3)], bounds


def _scales(log_scales: NDArray[np.float32]) -> tuple[NDArray[np.uint32], list[float]]:
    low, high = _scale_range(log_scales)
    step = max(high - low, 1e-6) / 1023
    cells = np.round((log_scales.clip(low, high) - low) / step).clip(0, 1023).astype(np.uint32)
    return _packed_bits(cells, (0, 10, 20)), [low, step]


def _scale_range(log_scales: NDArray[np.float32]) -> tuple[float, float]:
    """Return the least and largest log scale that are told apart, at most `LOG_RANGE` apart.

    Where they are farther apart, as many Gaussians as possible keep their largest axis: a few huge ones become smaller.
    """
    tops = np.sort(log_scales.max(axis=1).astype(np.float64))
    held = np.arange(1, len(tops) + 1) - np.searchsorted(tops, tops - LOG_RANGE)
    top = tops[held.argmax()]
    least = float(log_scales[log_scales >= top - LOG_RANGE].min())
    high = min(float(tops[-1]), least + LOG_RANGE)
    return max(float(log_scales.min()), high - LOG_RANGE), high


def _colors(dc: NDArray[np.float32]) -> tuple[NDArray[np.uint32], list[float]]:
    base = (0.5 + SH_C0 * dc.astype(np.float64)).clip(-BRIGHTEST, BRIGHTEST)
    low, high = float(base.min()), float(base.max())
    share = (base - low) / max(high - low, 1e-6)
    cells = np.round(share * np.array([2047, 2047, 1023])).astype(np.uint32)
    return _packed_bits(cells, (0, 11, 22)), [low, max(high - low, 1e-6) / 2047]


def _coefficients(rest: NDArray[np.float32], degree: int) -> tuple[NDArray[np.uint8], list[float]]:
    """Return the bytes [N,3K] (a coefficient's three colours together), and the step of each band."""
    rest = rest.clip(-BRIGHTEST, BRIGHTEST)
    cells = np.full(rest.shape, 128, np.uint8)
    steps = []
    for band in range(1, degree + 1):
        of_band = slice(band**2 - 1, (band + 1) ** 2 - 1)
        step = max(float(np.abs(rest[:, of_band]).max()) / 127, LEAST_STEP)
        cells[:, of_band] = (np.round(rest[:, of_band] / step) + 128).clip(0, 255).astype(np.uint8)
        steps.append(step)
    return cells.reshape(len(rest), -1), steps


def _rotations(quats: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Code [N,4] (w,x,y,z) of any norm: index of the largest part, then the others, each in -1/sqrt(2)..1/sqrt(2)."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = np.where(norms > 0, quats / np.maximum(norms, 1e-30), np.array([1, 0, 0, 0], np.float32))
    largest = np.abs(unit).argmax(axis=1)
    unit = unit * np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1, 1)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    three = np.take_along_axis(unit, others, axis=1) * np.sqrt(2)
    cells = (np.round(three * 511) + 511).clip(0, 1022).astype(np.uint32)
    return _packed_bits(np.concatenate([largest[:, None], cells], axis=1), (30, 20, 10, 0))


def _packed_bits(fields: NDArray[Any], shifts: tuple[int, ...]) -> NDArray[np.uint32]:
    """Put the fields of each row [N,F] into one word, each at its shift."""
    words: NDArray[np.uint32] = np.bitwise_or.reduce(fields.astype(np.uint32) << np.array(shifts, np.uint32), axis=1)
    return words
