"""Place of a model: about the local origin of a georeferenced scene, or in the world of the scene's files."""

from __future__ import annotations

import logging
from typing import TypeVar

import torch

from splatwizard_core.gaussians.model import WORLD_ORIGIN, GaussianModel, Origin
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.scene.scene import Scene

log = logging.getLogger(__name__)

AnyModel = TypeVar("AnyModel", bound=SplatModel)
NOWHERE: Origin = (0.0, 0.0, 0.0)


def with_origin(model: SplatModel, origin: Origin) -> None:
    """Note where the origin of a model's coordinates lies, for the next file; nothing for 0."""
    if isinstance(model, GaussianModel) and any(origin):
        model.origin = {**model.origin, WORLD_ORIGIN: list(origin)}


def placed_in(model: AnyModel, scene: Scene, name: str = "the model") -> AnyModel:
    """The model, moved in place to the origin of a scene.

    A model whose file does not say where it stands is taken to be in the world of the scene's files if it lies nearer
    to the scene there than about the local origin, and that is told.

    name    of the file, for the message
    """
    if not isinstance(model, GaussianModel) or not model.num_rows:
        return model
    here = torch.tensor(scene.origin, dtype=torch.float64)
    told = model.world_origin
    if told is not None:
        shift = torch.tensor(told, dtype=torch.float64) - here
    elif any(scene.origin):
        middle = model.means.detach().double().cpu().median(dim=0).values
        if (middle - here).norm() >= middle.norm():
            return model
        shift = -here
        log.warning("%s: it stands in the world of the scene's files and is moved to the scene's local origin", name)
    else:
        return model
    if bool(shift.any()):
        with torch.no_grad():
            model.means.copy_(model.means.double() + shift.to(model.device))
    model.origin = {**model.origin, WORLD_ORIGIN: list(scene.origin)}
    return model


# Old names of the api, until 0.4.


def origin_of(model: SplatModel) -> Origin | None:
    return getattr(model, "world_origin", None)


def world_shift(model: SplatModel) -> Origin | None:
    return getattr(model, "world_shift", None)
