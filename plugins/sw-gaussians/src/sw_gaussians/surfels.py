"""Flat Gaussians (surfels): the model of 2DGS and of methods based on it.

Source: 2D Gaussian Splatting (arXiv 2403.17888).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from splatwizard_core.api import GaussianModel, UserInputError

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter

PRIMITIVE, SURFEL = "primitive", "surfel"
"""Header key and value that mark a file of surfels; absent for other Gaussians."""

SURFEL_THICKNESS = 1e-8
"""Third scale of a surfel converted to an ellipsoid, world units."""


@dataclass(frozen=True)
class Surface:
    """Settings with which a model's surface was trained; they decide how its depth is read.

    depth_ratio     r of `sw_gaussians.surface.surface_depth`, 0..1
    lambda_dist     weight of the distortion, >= 0
    lambda_normal   weight of the normal consistency, >= 0
    """

    depth_ratio: float
    lambda_dist: float = 0.0
    lambda_normal: float = 0.0


class SurfelModel(GaussianModel):
    """N surfels: Gaussians on planes. Only a rasterizer with the feature SURFEL draws them.

    log_scales  [N,2] along the first two columns of the rotation; the third is the normal, on either side
    surface     how its surface was trained; None: nobody knows (a .ply says nothing of it)

    All else is as in GaussianModel.
    """

    NUM_SCALES = 2

    surface: Surface | None = None

    def state_dict_extra(self) -> dict[str, Any]:
        """The state of GaussianModel, and `surface`."""
        return {**super().state_dict_extra(), "surface": None if self.surface is None else asdict(self.surface)}

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        super().load_state_dict_extra(extra)
        self.surface = None if extra["surface"] is None else Surface(**extra["surface"])


def gaussians_of(
    means: Tensor,
    sh_dc: Tensor,
    sh_rest: Tensor,
    opacity_logits: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    *,
    active_sh_degree: int | None = None,
) -> GaussianModel:
    """Make a SurfelModel of raw tensors with log_scales [N,2], else a GaussianModel (shapes: that class)."""
    kind = SurfelModel if log_scales.shape[-1] == SurfelModel.NUM_SCALES else GaussianModel
    return kind(means, sh_dc, sh_rest, opacity_logits, log_scales, quats, active_sh_degree=active_sh_degree)


def refuse_surfels(model: GaussianModel, who: str) -> None:
    """Raise UserInputError if `model` holds surfels; for code that needs three scales."""
    if model.NUM_SCALES == SurfelModel.NUM_SCALES:
        raise UserInputError(
            f"{who} takes Gaussians with three scales each, and these are surfels with two (2DGS); "
            "`sw export --format ply-as-3dgs` makes flat ellipsoids of them"
        )


def as_ellipsoids(model: GaussianModel) -> GaussianModel:
    """Return surfels as ellipsoids 1e-8 world units thick, for viewers that know no others; a copy.

    A rasterizer of ellipsoids widens them by its low-pass filter: the picture is not that of the surfels. A model
    of ellipsoids is returned as it is.
    """
    if model.NUM_SCALES != SurfelModel.NUM_SCALES:
        return model
    thickness = torch.full_like(model.opacity_logits, math.log(SURFEL_THICKNESS))
    flat = GaussianModel.from_tensors(
        model.means,
        model.sh_dc,
        model.sh_rest,
        model.opacity_logits,
        torch.cat([model.log_scales, thickness[:, None]], dim=1),
        model.quats,
        active_sh_degree=model.active_sh_degree,
    )
    flat.origin = model.origin
    return flat


def state_surfels(model: GaussianModel, writer: ContainerWriter) -> None:
    """Mark the header of a file if its Gaussians are surfels."""
    if model.NUM_SCALES == SurfelModel.NUM_SCALES:
        writer.static[PRIMITIVE] = SURFEL


def stated_scales(reader: ContainerReader) -> int:
    """Return how many scales a Gaussian of a file has: 2 if its header says `primitive = surfel`, 3 without it.

    Raises BitstreamError for any other primitive.
    """
    if PRIMITIVE not in reader.static:
        return GaussianModel.NUM_SCALES
    reader.text(PRIMITIVE, choices=[SURFEL])
    return SurfelModel.NUM_SCALES


def state_surface(model: GaussianModel, writer: ContainerWriter) -> None:
    """Write into the header of a file how its surface was trained, where that is known."""
    if isinstance(model, SurfelModel) and model.surface is not None:
        writer.static.update(asdict(model.surface))


def stated_surface(reader: ContainerReader) -> Surface | None:
    """Return what a header says of the surface; None if it says nothing. Raises BitstreamError."""
    if "depth_ratio" not in reader.static:
        return None
    limit = 1e9
    return Surface(
        reader.number("depth_ratio", low=0, high=1),
        reader.number("lambda_dist", low=0, high=limit),
        reader.number("lambda_normal", low=0, high=limit),
    )
