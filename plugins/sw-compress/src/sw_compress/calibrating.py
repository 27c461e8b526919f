"""A sample of a large scene held against all of it: bytes and errors of each attribute, before anything is chosen.

A sample among stand-ins does not tell them well. What hides it is coarse, so cameras see more of it than of the same
Gaussians in the scene, and runs of neighbours are few against the places where a picture has most of its error. So at
one choice of levels all of the scene is drawn with each attribute rounded alone, and its bytes are estimated; what the
sample says is multiplied by what was found for the whole over what was expected, at any choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatwizard_core.api import Camera, GaussianInputs, RasterOptions, track
from sw_compress import coders
from sw_compress.coders import POSITIONS, Levels, Quantized
from sw_compress.large_scene import LargeScene
from sw_compress.quality import Pictures
from sw_compress.rounding import Rounding
from sw_compress.rows import IMPORTANCE, select, with_degree
from sw_compress.stages import give_back

if TYPE_CHECKING:
    from splatwizard_core.api import GaussianModel, Rasterizer
    from sw_codecs.models.sh_basis import Basis
    from sw_compress.measuring import Errors

Array = NDArray[np.float64]

MOST_APART = 4.0
"""Factor by which that of one attribute may be larger or smaller than that of all: it was found at one level only."""


def calibrate(
    errors: Errors, sample: GaussianModel, scene: LargeScene, importance: Tensor, coder: Quantized, levels: Levels,
    cameras: Sequence[Camera], rasterizer: Rasterizer,
) -> Pictures:  # fmt: skip
    """Make what a sample told agree with the whole; return pictures of that.

    errors      of the sample, which are corrected
    importance  of each Gaussian of the whole [N]
    levels      at which errors are compared
    """
    share = sample.num_rows / scene.num_rows
    sizes, basis = sizes_of(scene, importance, coder, sample.active_sh_degree)
    found, pictures = _Rounded(scene, importance, coder, levels, basis).alone(cameras, rasterizer)
    give_back()
    names, expected = coder.attributes(sample), coder.sizes(sample)
    told = {name: float(errors.at(name, np.array([levels[name]]))[0]) / share for name in names}
    all_of = sum(found[name] for name in names) / max(sum(told.values()), 1e-30)
    for name in names:  # of coefficients that are left out nothing is known
        factor = found[name] / max(told[name] * all_of, 1e-30)
        more = np.maximum(sizes[name] * share, 1) / np.maximum(expected[name], 1)
        errors.correct(name, more, all_of * min(max(factor, 1 / MOST_APART), MOST_APART))
    return pictures


def sizes_of(
    scene: LargeScene, importance: Tensor, coder: Quantized, degree: int
) -> tuple[dict[str, Array], Basis | None]:
    """Bytes of each attribute of a scene at each of its levels, SH up to a degree, and a basis of all of these."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.randperm(scene.num_rows, generator=generator)[: coders.SAMPLE].sort().values.to(scene.device)
    some = scene.part(rows)
    setattr(some, IMPORTANCE, importance[rows])
    few = with_degree(some, degree)
    setattr(few, IMPORTANCE, importance[rows])
    sizes = coder.column_sizes(few, scene.num_rows, len(scene.tiles))
    basis = Rounding(some, coder.power, coders.OWN_BASIS).basis
    del some, few
    give_back()
    return {**sizes, POSITIONS: coders.position_sizes(scene.light, limits=scene.limits)}, basis


class _Rounded:
    """A scene as a file of some levels decodes to, made where it is drawn.

    importance  of each Gaussian [N]
    basis       of higher SH coefficients
    """

    @torch.no_grad()
    def __init__(
        self, scene: LargeScene, importance: Tensor, coder: Quantized, levels: Levels, basis: Basis | None
    ) -> None:
        self.scene, self._basis, self._steps = scene, basis, coder.whole_steps(levels)
        setattr(scene.light, IMPORTANCE, importance)
        rounding = Rounding(scene.light, coder.power, False)
        self.light, self._classes = rounding.model_at(self._steps), rounding.classes
        # Of a Gaussian whose scales come in another order its quaternion is another one, too.
        finest = coder.whole_steps(coder.finest(scene.light))
        self.scales, self.quats = rounding.parameter("scale", finest).exp(), rounding.parameter("quat", finest)
        delattr(scene.light, IMPORTANCE)

    def dc(self, rows: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
        """Coefficients of some rows, with dc rounded."""
        return self.light.sh_dc[rows], rest

    def rest(self, rows: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
        """The same with the others rounded."""
        model = select(self.scene.light, rows)
        model.sh_rest.data, model.active_sh_degree = rest, self.scene.degree
        rounding = Rounding(model, 0.0, False)
        rounding.classes, rounding.basis = None if self._classes is None else self._classes[rows], self._basis
        return self.scene.light.sh_dc[rows], rounding.parameter("rest", self._steps)

    def both(self, rows: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
        """The same with all rounded."""
        return self.light.sh_dc[rows], self.rest(rows, rest)[1] if self.scene.degree else rest

    @torch.no_grad()
    def alone(self, cameras: Sequence[Camera], rasterizer: Rasterizer) -> tuple[dict[str, float], Pictures]:
        """Mean squared error of pictures with each attribute rounded alone, and the pictures."""
        scene, light, rounded = self.scene, self.scene.light, self.light
        pictures = Pictures(light, [], rasterizer, RasterOptions(alpha=True))
        found: dict[str, float] = {}
        others = [self.dc, self.rest] if scene.degree else [self.dc]
        with track("measure precision of all", total=len(cameras), unit="views") as bar:
            for view, camera in enumerate(cameras):
                colors = scene.colors(camera, seen_by(camera, scene, rasterizer), *others)
                plain = GaussianInputs(light.means, light.opacities, light.scales, light.quats, colors=colors[0])
                pictures.add(_Drawn(plain), camera)
                changes = {
                    "positions": {"means": rounded.means}, "opacity": {"opacities": rounded.opacities},
                    "scale": {"scales": rounded.scales, "quats": self.quats},
                    "quat": {"scales": self.scales, "quats": rounded.quats}, "dc": {"colors": colors[1]},
                }  # fmt: skip
                if scene.degree:
                    changes["rest"] = {"colors": colors[2]}
                for name, change in changes.items():
                    error = pictures.error_of(view, _Drawn(replace(plain, **change)))
                    found[name] = found.get(name, 0.0) + error / len(cameras)
                del colors, plain, changes, change
                give_back()
                bar.advance()
        return found, pictures

    @torch.no_grad()
    def together(self, pictures: Pictures, rasterizer: Rasterizer) -> float:
        """Mean squared error of pictures with all rounded."""
        found, light = 0.0, self.light
        for view, camera in enumerate(pictures.cameras):
            colors = self.scene.colors(camera, seen_by(camera, self.scene, rasterizer), self.both)[1]
            drawn = GaussianInputs(light.means, light.opacities, light.scales, light.quats, colors=colors)
            found += pictures.error_of(view, _Drawn(drawn)) / len(pictures.cameras)
        return found


def rounded_error(
    scene: LargeScene, importance: Tensor, coder: Quantized, levels: Levels, basis: Basis | None, pictures: Pictures,
    rasterizer: Rasterizer,
) -> float:  # fmt: skip
    """Mean squared error of the pictures that a file of these levels gives."""
    return _Rounded(scene, importance, coder, levels, basis).together(pictures, rasterizer)


def seen_by(camera: Camera, scene: LargeScene, rasterizer: Rasterizer) -> Tensor:
    """Whether each Gaussian [N] may be in the picture."""
    light = scene.light
    plain = GaussianInputs(light.means, light.opacities, light.scales, light.quats, colors=light.means)
    return rasterizer.visible_filter(plain, camera.to(light.device)) > 0


class _Drawn:
    """Gaussians of a model as one camera sees them."""

    def __init__(self, gaussians: GaussianInputs) -> None:
        self._gaussians, self.device = gaussians, gaussians.means.device

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        return self._gaussians
