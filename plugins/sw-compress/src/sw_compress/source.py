"""The scene that is compressed: any file of explicit Gaussians, or a model."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from sw_gaussians import heap
from sw_gaussians.render_options import antialias_of, raster_of
from sw_gaussians.surfels import refuse_surfels

from splatwizard_core.api import GaussianModel, SceneError, UserInputError
from splatwizard_core.tooling import bytes_with_named, existing_file, open_model, read_gaussians
from sw_compress.rows import bare, select

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager

FAINTEST = 1 / 255
"""Opacity below which a Gaussian is never drawn."""
MANY = 100_000
"""Gaussians of a scene whose copies are much of the memory that it takes."""


@dataclass(frozen=True)
class Source:
    """Gaussians to compress.

    model       without those that can never be drawn
    read        how many the file holds
    file_bytes  of the file; None: there is none
    """

    name: str
    model: GaussianModel
    read: int
    file_bytes: int | None

    @property
    def antialiased(self) -> bool:
        """True where it was trained with the opacity compensation of the low-pass filter, and is to be drawn so."""
        return antialias_of(self.model)

    @property
    def raster(self) -> dict[str, object]:
        """Options that its file asks of a renderer, as the compressed one will."""
        return raster_of(self.model)


def open_source(given: str | os.PathLike[str] | GaussianModel, plugins: PluginManager, device: torch.device) -> Source:
    """Read a file, or take a model. Raises UserInputError, SceneError, BitstreamError."""
    if isinstance(given, GaussianModel):
        return _source("scene", given.to(device), None)
    path = existing_file(str(given))
    if plugins.importers.of_suffix(path) is not None:
        return _source(path.name, bare(read_gaussians(path, plugins)).to(device), bytes_with_named(path))
    with path.open("rb") as file:
        is_ours = path.suffix.lower() == ".swz" or file.read(4) == b"SPWZ"
    if not is_ours:
        known = sorted({".swz", *(str(e.declared["suffix"]) for e in plugins.importers if "suffix" in e.declared)})
        raise UserInputError(f"{path}: of none of the formats that are read, {', '.join(known)}")
    model, reader = open_model(path, plugins, device)
    if not isinstance(model, GaussianModel):
        raise UserInputError(
            f"{path.name}: Gaussians of method '{reader.method}' depend on the camera: `sw bake` makes explicit ones"
        )
    return _source(path.name, bare(model), path.stat().st_size)


def lay_aside(model: GaussianModel, folder: Path) -> None:
    """Let higher SH coefficients of many Gaussians on a CPU lie in a file in a folder: most stages look at other copies
    of them."""
    if model.device.type == "cpu" and model.num_rows > MANY:
        model.sh_rest.data = heap.in_file(model.sh_rest, folder)
        heap.trim()


def _source(name: str, model: GaussianModel, file_bytes: int | None) -> Source:
    refuse_surfels(model, f"{name}: `sw compress`")
    model.check_finite()
    model = model.eval().requires_grad_(False)
    drawn = model.opacities >= FAINTEST
    if not bool(drawn.any()):
        raise SceneError(f"{name}: holds no Gaussian that could be seen")
    return Source(name, model if bool(drawn.all()) else select(model, drawn), model.num_rows, file_bytes)
