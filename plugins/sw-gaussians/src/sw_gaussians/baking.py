"""Baking: fit explicit Gaussians to a model whose Gaussians depend on the camera, over given cameras.

Viewers and interchange formats need explicit Gaussians; anchors with small networks (Scaffold-GS, HAC) are not.
Positions do not depend on the camera. Opacity, scale, rotation and colour do, so they are fitted per Gaussian over the
cameras that see it: the first three as weighted means, the colour as spherical harmonics by least squares.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch
from sw_reference.spherical_harmonics import sh_basis, sh_colors
from torch import Tensor
from torch.nn.functional import normalize

from splatwizard_core.api import (
    SH,
    Camera,
    GaussianInputs,
    GaussianModel,
    RasterOptions,
    SceneError,
    ScoreSpec,
    SplatModel,
    UserInputError,
    track,
)

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer

BLEND = ScoreSpec("blend", "blend")
"""Name of the score that weights views: sum over pixels of alpha times transmittance."""
MIN_OPACITY = 1 / 255
"""Opacity below which a Gaussian is not drawn."""
MAX_OPACITY = 1 - 1e-5
"""Largest opacity; an opacity of 1 has no finite logit."""
HIDDEN_VIEW_WEIGHT = 1e-3
"""Weight, in pixels, of a view in which a Gaussian is hidden; it matters only if all views hide it."""
RIDGE = 0.005
"""Ridge regularisation of the higher SH bands, as a share of the total view weight."""
SOLVE_BATCH = 1 << 15
"""Number of Gaussians whose least-squares systems are solved per call."""


@runtime_checkable
class NumbersGaussians(Protocol):
    """A model whose Gaussians differ per view, and which numbers them across views."""

    @property
    def num_gaussian_ids(self) -> int:
        """Largest number of Gaussians, over all views."""
        ...

    def gaussian_ids(self, inputs: GaussianInputs) -> Tensor:
        """Return the ids [M] int64, unique, in 0 .. num_gaussian_ids - 1, of the Gaussians of one view."""
        ...


def bake(
    model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer, options: RasterOptions, *, sh_degree: int = 2
) -> GaussianModel:
    """Return explicit Gaussians, on the model's device, that approximate its renders from `cameras`.

    cameras     at least one, on any device; Gaussians that none of them sees are left out
    options     as the model is drawn
    sh_degree   0 .. 3, of the colours

    A view counts for a Gaussian by how much of it is seen: the sum over pixels of its share of the light, without its
    own opacity. No gradient. Raises UserInputError for a model that is explicit already, SceneError if nothing is seen.
    """
    if isinstance(model, GaussianModel):
        raise UserInputError("the Gaussians are explicit already: they need no baking")
    if not 0 <= sh_degree <= 3:
        raise UserInputError(f"SH degree {sh_degree} is outside 0 .. 3")
    blending = replace(options, scores=(BLEND,), depth=frozenset(), normals=False, alpha=False)
    places = [camera.to(model.device) for camera in cameras]
    with torch.no_grad(), track("bake", total=3 * len(places), unit="views") as bar:

        def views() -> Iterable[_View]:
            for camera in places:
                yield _view(model, camera, rasterizer)
                bar.advance()

        most = model.num_gaussian_ids if isinstance(model, NumbersGaussians) else model.counts()["num_gaussians"]
        slots, means = _positions(views(), most)
        # Which views see a Gaussian is first guessed, then asked of a rasterizer that draws the guess.
        fit = _Fit(means, slots, None)
        for view in views():
            fit.add(view, _in_picture(means, view.camera).float())
        guess = fit.shapes()
        fit = _Fit(means, slots, sh_degree)
        for view in views():
            blend = rasterizer.render(guess, view.camera, blending).scores[BLEND.name]
            fit.add(view, blend / guess.opacities.clamp_min(MIN_OPACITY) + HIDDEN_VIEW_WEIGHT)
        found = fit.shapes()
        return _model(replace(found, sh=SH(dense=fit.harmonics())))


@dataclass(frozen=True)
class _View:
    """The M Gaussians that one camera draws: their ids [M] and colours [M,3]."""

    ids: Tensor
    inputs: GaussianInputs
    colors: Tensor
    camera: Camera


def _view(model: SplatModel, camera: Camera, rasterizer: Rasterizer) -> _View:
    inputs = model.gaussians(camera, rasterizer).gathered()
    if inputs.scales is None or inputs.scales.shape[1] != 3:
        raise UserInputError("surfels and Gaussians given as covariances cannot be baked")
    colors = inputs.colors
    if colors is None:
        assert inputs.sh is not None
        colors = sh_colors(inputs.sh, camera.center, inputs.means)
    if isinstance(model, NumbersGaussians):
        return _View(model.gaussian_ids(inputs), inputs, colors, camera)
    if len(inputs) != model.counts()["num_gaussians"]:
        raise UserInputError("this model does not say which of its Gaussians a view draws")
    return _View(torch.arange(len(inputs), device=colors.device), inputs, colors, camera)


def _positions(views: Iterable[_View], count: int) -> tuple[Tensor, Tensor]:
    """Number the N Gaussians that any view draws: id -> row [count] int64 (-1: never drawn), and their means [N,3]."""
    means: Tensor | None = None
    for view in views:
        if means is None:
            means = view.inputs.means.new_full((count, 3), torch.nan)
        means[view.ids] = view.inputs.means
    drawn = torch.zeros(0, dtype=torch.bool) if means is None else means.isfinite().all(dim=1)
    if means is None or not drawn.any():
        raise SceneError("no Gaussian is seen by the cameras, so there is nothing to bake")
    slots = torch.full((count,), -1, device=means.device)
    slots[drawn] = torch.arange(int(drawn.sum()), device=means.device)
    return slots, means[drawn]


def _in_picture(means: Tensor, camera: Camera) -> Tensor:
    """Return [N] bool: whether a mean projects into the image."""
    x, y, z = (means @ camera.R.T + camera.tau).unbind(1)
    tx, ty = camera.tan_half_fov
    return (z > camera.near) & (x.abs() < tx * z) & (y.abs() < ty * z)


class _Fit:
    """Weighted means over views of N Gaussians, and the normal equations of their colours.

    means   [N,3]
    slots   id -> number, or -1
    degree  of the spherical harmonics; None: colours are not fitted
    """

    def __init__(self, means: Tensor, slots: Tensor, degree: int | None) -> None:
        n = len(means)
        self.means, self.slots, self.degree = means, slots, degree
        self._weight, self._opacity, self._shown = means.new_zeros(3, n)
        self._log_scales, self._quats = means.new_zeros(n, 3), means.new_zeros(n, 4)
        self._terms = 0 if degree is None else (degree + 1) ** 2
        self._upper = torch.triu_indices(self._terms, self._terms, device=means.device)
        self._products = means.new_zeros(n, self._upper.shape[1])  # upper triangle of the sum of w b b^T
        self._colors = means.new_zeros(n, self._terms, 3)  # sum of w b (c - 0.5)

    def add(self, view: _View, weights: Tensor) -> None:
        """Add a view with the weights [N] of all Gaussians; those it does not draw count with opacity 0."""
        own = self.slots[view.ids]
        known = own >= 0  # all but those whose mean is not finite
        rows, inputs = own[known], view.inputs
        assert inputs.scales is not None
        assert inputs.quats is not None
        opacities = inputs.opacities[known]
        seen = weights.clone()
        seen[rows] = seen[rows].clamp_min(HIDDEN_VIEW_WEIGHT)
        self._weight += seen
        shown = seen[rows] * opacities  # [M] what of it is in the picture
        self._opacity[rows] += shown
        self._log_scales[rows] += shown[:, None] * inputs.scales[known].clamp_min(1e-12).log()
        quats, sums = normalize(inputs.quats[known], dim=1), self._quats[rows]
        alike = (quats * sums).sum(dim=1, keepdim=True) >= 0  # q and -q turn alike
        self._quats[rows] = sums + shown[:, None] * torch.where(alike, quats, -quats)
        if self.degree is not None:
            basis = sh_basis(normalize(inputs.means[known] - view.camera.center, dim=1), self.degree)  # [M,K]
            first, second = self._upper
            self._products[rows] += shown[:, None] * basis[:, first] * basis[:, second]
            self._colors[rows] += (shown[:, None] * basis)[:, :, None] * (view.colors[known] - 0.5)[:, None]

    def shapes(self) -> GaussianInputs:
        """Return grey Gaussians whose opacity, scale and rotation are the weighted means over the views."""
        shown = self._opacity.clamp_min(1e-20)[:, None]
        opacities = (self._opacity / self._weight.clamp_min(1e-20)).clamp(0, MAX_OPACITY)
        quats = normalize(self._quats, dim=1)
        return GaussianInputs(
            self.means, opacities, (self._log_scales / shown).exp(), quats, colors=torch.full_like(self.means, 0.5)
        )

    def harmonics(self) -> Tensor:
        """Return SH coefficients [N,K,3], the least-squares fit to the colours of the views."""
        shown = self._opacity.clamp_min(1e-20)[:, None]
        ridge = self.means.new_full((self._terms,), RIDGE)
        ridge[0] = 1e-6
        found = []
        for products, colors in zip(
            (self._products / shown).split(SOLVE_BATCH),
            (self._colors / shown[:, :, None]).split(SOLVE_BATCH),
            strict=True,
        ):
            matrix = products.new_zeros(len(products), self._terms, self._terms)
            matrix[:, self._upper[0], self._upper[1]] = products
            matrix[:, self._upper[1], self._upper[0]] = products
            found.append(torch.linalg.solve(matrix + torch.diag(ridge), colors))
        return torch.cat(found)


def _model(g: GaussianInputs) -> GaussianModel:
    """Return a model of raw parameters, without Gaussians too transparent to be drawn."""
    assert g.sh is not None
    assert g.scales is not None
    assert g.quats is not None
    kept = g.opacities >= MIN_OPACITY
    if not kept.any():
        raise SceneError("no Gaussian is opaque enough to be drawn, so there is nothing to bake")
    sh = g.sh.to_dense()[kept]
    model = GaussianModel.from_tensors(
        g.means[kept], sh[:, :1], sh[:, 1:], torch.logit(g.opacities[kept]), g.scales[kept].log(), g.quats[kept]
    )
    return model.requires_grad_(False)
