"""The neutral model: what every reader makes, every writer takes, and what both have to tell."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError, LeftOut, UserInputError, beyond_limit
from sw_interchange.bands import COEFFICIENTS, Array
from sw_interchange.frames import in_frame

FLAT = -20.0
"""Log scale of what has no thickness."""
LARGEST_LOGIT = 13.815510
"""Logit of an opacity of 1 - 1e-6: beyond it float32 knows no difference."""

NO_MORE_SEEN = 2e-4
"""Share of the scene's extent below which a displacement is seen in no picture."""
SHORTEST_QUAT = 1e-12
"""Norm below which a quaternion has no direction."""
SMALLEST_SCALE, LARGEST_SCALE = np.float32(-87.33), np.float32(88.72)
"""Log scales whose exponentials are normal numbers of float32."""


@dataclass(frozen=True)
class Limits:
    """Bounds on what a file may make a reader allocate, besides those by the size of the file.

    max_gaussians       rows
    max_output_bytes    of all that is decompressed from it
    """

    max_gaussians: int = 1 << 27
    max_output_bytes: int = 16 << 30

    def check(self, count: int, decoded_bytes: int, size: int, name: str) -> None:
        """Raise BitstreamError if a file of `size` bytes claims more, or more than so few bytes may stand for."""
        if count > self.max_gaussians:
            raise BitstreamError(f"{name}: claims {count:,} Gaussians, more than the limit of {self.max_gaussians:,}")
        if decoded_bytes > self.max_output_bytes:
            raise BitstreamError(f"{name}: decodes to {decoded_bytes:,} bytes, the limit is {self.max_output_bytes:,}")
        if (reason := beyond_limit(decoded_bytes, size)) is not None:
            raise BitstreamError(f"{name}: claims {count:,} Gaussians of {reason}")


def decoded_bytes(count: int, coefficients: int) -> int:
    """Bytes of Gaussians as float32, with so many SH coefficients per channel besides that of band 0."""
    return count * (56 + 12 * coefficients)


@dataclass
class ReadReport:
    """Facts of a file that was read.

    stored_frame    directions of +X, +Y, +Z in the file, as far as that is known
    repairs         kind of repair -> values
    dropped         rows that mean nothing
    left_out        of these, how many hold a value that is no number, and how many a rotation of zero
    ignored         parts of the file that mean nothing to a Gaussian
    """

    format: str
    version: str = ""
    num_gaussians: int = 0
    sh_degree: int = 0
    stored_frame: str = "RDF"
    bytes: int = 0
    repairs: dict[str, int] = field(default_factory=dict)
    dropped: int = 0
    left_out: dict[str, int] = field(default_factory=dict)
    ignored: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    def repaired(self, kind: str, count: int) -> None:
        """Count repairs, if there were any."""
        if count:
            self.repairs[kind] = self.repairs.get(kind, 0) + int(count)


@dataclass
class WriteReport:
    """Facts of a file that was written.

    clamped     field -> values beyond the range of the format
    lost        parts of the scene that the format cannot hold
    errors      measured losses, such as the root of the mean squared error of an SH palette
    """

    format: str
    bytes: int = 0
    num_gaussians: int = 0
    clamped: dict[str, int] = field(default_factory=dict)
    lost: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    errors: dict[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    def notices(self) -> list[str]:
        """Lines that a user should see: warnings, and what was clamped."""
        clamped = [f"{count:,} values of {field} lie beyond its range" for field, count in self.clamped.items()]
        return self.warnings + clamped

    def coarse(self, steps: Array, means: Array, log_scales: Array) -> None:
        """Warn of Gaussians whose positions are rounded so coarsely that the picture changes.

        steps   [N], [N,3] or one number: distance of neighbouring codes of a coordinate, units of the scene

        A position may be off by half a step: that is told where it is more than the Gaussian's own size, and more than
        a five-thousandth of the scene.
        """
        off = np.broadcast_to(np.asarray(steps, np.float64) / 2, means.shape if np.ndim(steps) != 1 else (len(means),))
        off = off if off.ndim == 1 else off.max(axis=1)
        with np.errstate(over="ignore"):
            size = np.exp(log_scales.max(axis=1).astype(np.float64))
        extent = float(np.median(np.abs(means - np.median(means, axis=0))))
        lost = (off > size) & (off > NO_MORE_SEEN * extent)
        if lost.any():
            self.warnings.append(
                f"coordinates of {int(lost.sum()):,} of {len(means):,} Gaussians lose up to {off[lost].max():.3g} "
                "units, more than their own size: the format's precision follows the farthest Gaussian; remove what "
                "lies far out"
            )

    def count(self, name: str, mask: npt.NDArray[np.bool_]) -> None:
        """Count the values of a field that are clamped, if there are any."""
        if found := int(np.count_nonzero(mask)):
            self.clamped[name] = self.clamped.get(name, 0) + found


@dataclass
class GaussianScene:
    """N Gaussians, raw (pre-activation) values, float32.

    means           [N,3]
    log_scales      [N,3] natural log of the standard deviations; of surfels the third is -20
    quats           [N,4] w,x,y,z, of norm 1
    opacity_logits  [N]
    sh_dc           [N,3] coefficient of band 0: colour = 0.5 + 0.28209 sh_dc
    sh_rest         [N,K,3] bands 1 .., K = 0, 3, 8, 15 or 24
    frame           directions of +X, +Y, +Z: R or L, U or D, F or B. RDF is that of COLMAP and of 3DGS
    antialiased     trained with the opacity compensation of Mip-Splatting
    kind            "default", or "2dgs": surfels
    meta            what else the file says: comments, extensions as raw bytes
    report          of the reader
    """

    means: Array
    log_scales: Array
    quats: Array
    opacity_logits: Array
    sh_dc: Array
    sh_rest: Array
    frame: str = "RDF"
    antialiased: bool = False
    kind: str = "default"
    meta: Mapping[str, Any] = field(default_factory=dict)
    report: ReadReport | None = None

    def __post_init__(self) -> None:
        n = len(self.means)
        tails = {"means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (), "sh_dc": (3,)}
        for name, tail in tails.items():
            if getattr(self, name).shape != (n, *tail):
                raise UserInputError(f"GaussianScene.{name} is {getattr(self, name).shape}, expected {(n, *tail)}")
        rest = self.sh_rest.shape
        if len(rest) != 3 or rest[0] != n or rest[1] not in COEFFICIENTS.values() or rest[2] != 3:
            raise UserInputError(f"GaussianScene.sh_rest is {rest}, expected ({n}, 0|3|8|15|24, 3)")

    @property
    def num_gaussians(self) -> int:
        """N."""
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """The highest band, 0..4."""
        return math.isqrt(self.sh_rest.shape[1] + 1) - 1

    def select(self, rows: npt.NDArray[Any] | slice) -> GaussianScene:
        """The Gaussians of an index or mask [N], in that order; views of those of a slice."""
        names = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def with_degree(self, degree: int) -> GaussianScene:
        """The same without the bands above `degree`."""
        return replace(self, sh_rest=self.sh_rest[:, : COEFFICIENTS[degree]])

    def in_frame(self, frame: str) -> GaussianScene:
        """The same scene in other axes, such as "RUB"; see `frames`."""
        return in_frame(self, frame)


def joined(scenes: Sequence[GaussianScene]) -> GaussianScene:
    """One scene of several in the same frame; SH bands that one lacks are zero. The rest is that of the first."""
    if len(scenes) == 1:
        return scenes[0]
    k = max(scene.sh_rest.shape[1] for scene in scenes)
    rest = [np.pad(scene.sh_rest, ((0, 0), (0, k - scene.sh_rest.shape[1]), (0, 0))) for scene in scenes]
    names = ("means", "log_scales", "quats", "opacity_logits", "sh_dc")
    columns = {name: np.concatenate([getattr(scene, name) for scene in scenes]) for name in names}
    return replace(scenes[0], **columns, sh_rest=np.concatenate(rest))


def sigmoid(logits: Array) -> Array:
    """Opacity 0..1 of a logit."""
    with np.errstate(over="ignore"):
        return (1 / (1 + np.exp(-logits))).astype(np.float32, copy=False)


def logits_of(alphas: Array) -> Array:
    """Logit of opacities 0..1, both ends at 1e-6 and 1 - 1e-6."""
    with np.errstate(all="ignore"):
        found = np.log(alphas) - np.log1p(-alphas)
    return np.clip(found, -LARGEST_LOGIT, LARGEST_LOGIT).astype(np.float32)


def linear_scales(log_scales: Array, report: WriteReport) -> Array:
    """Standard deviations within the normal numbers of float32; what is clamped to them is counted."""
    found = np.clip(log_scales, SMALLEST_SCALE, LARGEST_SCALE)
    report.count("log_scales", found != log_scales)
    return np.exp(found)


def logit_of_byte(codes: npt.NDArray[np.uint8]) -> Array:
    """Logit of code / 255, both ends at 1e-6 and 1 - 1e-6."""
    alphas = np.clip(np.arange(256) / 255, 1e-6, 1 - 1e-6)
    table: Array = np.log(alphas / (1 - alphas)).astype(np.float32)
    return table[codes]


def cleaned(scene: GaussianScene, report: ReadReport, *, strict: bool, name: str) -> GaussianScene:
    """Make what a file held sound: rows that mean nothing go, infinite opacities and scales become finite, quats unit.

    A row means nothing if a value is no number, or its rotation is zero.

    strict  raise BitstreamError instead of dropping rows
    """
    sound = np.ones(scene.num_gaussians, bool)
    for values in (
        scene.means,
        scene.quats,
        scene.sh_dc,
        scene.sh_rest.reshape(len(sound), 3 * scene.sh_rest.shape[1]),
    ):
        with np.errstate(all="ignore"):
            total = values.sum()  # one that is no number makes the sum none
        if not np.isfinite(total):
            sound &= np.isfinite(values).all(1)
    sound &= ~np.isnan(scene.opacity_logits)
    sound &= ~(np.isnan(scene.log_scales) | (scene.log_scales == np.inf)).any(1)
    with np.errstate(invalid="ignore"):
        still = sound & ~(np.abs(scene.quats).max(axis=1, initial=0) > SHORTEST_QUAT)
    if not sound.all() or still.any():
        left = LeftOut(int((~sound).sum()), int(still.sum()))
        report.dropped, report.left_out = sum(left), left._asdict()
        if strict:
            raise BitstreamError(f"{name}: {str(left).replace(' and were left out', '')}")
        scene = scene.select(sound & ~still)
    scales, logits = scene.log_scales, scene.opacity_logits
    if (infinite := scales == -np.inf).any():
        report.repaired("log_scales", int(infinite.sum()))
        scales = np.where(infinite, np.float32(FLAT), scales)
    if (infinite := np.isinf(logits)).any():
        report.repaired("opacity_logits", int(infinite.sum()))
        logits = np.where(infinite, np.copysign(np.float32(LARGEST_LOGIT), logits), logits)
    quats, _ = normalised(scene.quats)
    report.num_gaussians, report.sh_degree = scene.num_gaussians, scene.sh_degree
    return replace(scene, log_scales=scales, opacity_logits=logits, quats=quats, report=report)


def normalised(quats: Array) -> tuple[Array, int]:
    """Unit quaternions [N,4], and how many were too short for that and are the identity now.

    Those of norm 1 up to rounding keep their bits.
    """
    squares = np.einsum("ij,ij->i", quats, quats, dtype=np.float64)
    off = np.flatnonzero(np.abs(squares - 1) > 4e-7)  # twice the rounding of a float32 quaternion
    if not len(off):
        return quats, 0
    quats = quats.copy()
    null = squares[off] < 1e-24
    squares[off[null]] = 1
    quats[off] = quats[off] / np.sqrt(squares[off])[:, None]
    quats[off[null]] = (1, 0, 0, 0)
    return quats, int(null.sum())
