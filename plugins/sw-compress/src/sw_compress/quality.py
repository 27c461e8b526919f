"""Distance of the pictures of a decoded scene from those of its source, with the same cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from splatwizard_core.api import Camera, GaussianModel, RasterOptions, ssim_map, track

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer

LARGEST_PSNR = 100.0
"""PSNR of equal pictures, dB."""
SHOWN = 1 / 255
"""Opacity from which a pixel counts: an empty background would make every scene look good."""
PHOTOGRAPHS = (27.0, 32.0, 36.0)
"""PSNR of scenes against their photographs for which the loss is told, dB: outdoor, indoor, rendered objects."""


def decibels(mse: float) -> float:
    """PSNR of a mean squared error of values in 0..1."""
    return LARGEST_PSNR if mse <= 10 ** (-LARGEST_PSNR / 10) else -10 * math.log10(mse)


def loss_against_photographs(psnr: float, photographs: float) -> float:
    """Decibels that a scene loses against photographs, to which it stands at `photographs` dB.

    psnr    of the decoded scene against its source, dB

    Errors of coding and of the model are taken as uncorrelated, so their squares add.
    """
    return 10 * math.log10(1 + 10 ** ((photographs - psnr) / 10))


def told_loss(psnr: float) -> str:
    """Tell in a sentence what a PSNR against the source costs."""
    losses = " / ".join(f"{loss_against_photographs(psnr, each):.2f}" for each in PHOTOGRAPHS)
    known = " / ".join(f"{each:g}" for each in PHOTOGRAPHS)
    return f"{psnr:.1f} dB to the source: it costs {losses} dB of photographs that the source meets at {known} dB"


@dataclass(frozen=True)
class Quality:
    """Of pictures against those of the source, dB but for `ssim`.

    psnr        of the mean squared error of pixels where either shows something, colours rounded to 8 bits
    psnr_full   of all pixels
    worst, p5   least PSNR of a view, and its 5 % quantile
    ssim        mean over views, 11 x 11 windows
    """

    psnr: float
    psnr_full: float
    worst: float
    p5: float
    ssim: float
    views: int

    def as_dict(self) -> dict[str, Any]:
        return dict(vars(self))


class Pictures:
    """Renders of a source, which those of other scenes are compared with."""

    def __init__(
        self,
        source: GaussianModel,
        cameras: Sequence[Camera],
        rasterizer: Rasterizer,
        options: RasterOptions,
        label: str = "draw the source",
    ) -> None:
        self.cameras, self._rasterizer, self._options = list[Camera](), rasterizer, options
        self._known: list[tuple[Tensor, Tensor]] = []
        with track(label, total=len(cameras), unit="views") as bar:
            for camera in cameras:
                self.add(source, camera)
                bar.advance()

    def add(self, source: GaussianModel, camera: Camera) -> None:
        """Draw another view of the source."""
        self.cameras.append(camera)
        self._known.append(self._drawn(source, camera))

    @torch.no_grad()
    def _drawn(self, model: GaussianModel, camera: Camera) -> tuple[Tensor, Tensor]:
        """Colours [3,H,W] in 0..1, and where something is shown [H,W]."""
        camera = camera.to(model.device)
        drawn = self._rasterizer.render(model.gaussians(camera, self._rasterizer), camera, self._options)
        assert drawn.alpha is not None  # the options ask for it
        return drawn.image.clamp(0, 1), drawn.alpha[0] > SHOWN

    def error(self, model: GaussianModel) -> float:
        """Mean squared error over pixels that show something, and over views, unrounded."""
        found = [self.error_of(view, model) for view in range(len(self.cameras))]
        return sum(found) / max(len(found), 1)

    def error_of(self, view: int, model: GaussianModel) -> float:
        """The same of one view."""
        known, known_shown = self._known[view]
        image, shown = self._drawn(model, self.cameras[view])
        return _masked((image - known).double().square(), shown | known_shown)

    def quality(self, model: GaussianModel, label: str = "measure") -> Quality:
        """Compare all views with colours rounded to 8 bits."""
        shown_only, full, similar = [], [], []
        with track(label, total=len(self.cameras), unit="views") as bar:
            for camera, (known, known_shown) in zip(self.cameras, self._known, strict=True):
                image, shown = self._drawn(model, camera)
                a, b = ((255 * each).round() / 255 for each in (image, known))
                squared = (a - b).double().square()
                shown_only.append(_masked(squared, shown | known_shown))
                full.append(float(squared.mean()))
                similar.append(float(ssim_map(a, b).double().mean()))
                bar.advance()
        each = sorted(decibels(mse) for mse in shown_only)
        count = len(each)
        return Quality(
            decibels(sum(shown_only) / count), decibels(sum(full) / count), each[0], each[int(0.05 * (count - 1))],
            sum(similar) / count, count,
        )  # fmt: skip


def _masked(squared: Tensor, shown: Tensor) -> float:
    """Mean of [3,H,W] where `shown` [H,W]."""
    count = int(shown.sum())
    return float((squared * shown).sum()) / (3 * count) if count else 0.0
