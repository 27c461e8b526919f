"""A model of a file together with what draws it: opened once, drawn from any camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import NegotiatedRasterizer, open_subject, render_view

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, RasterOptions, RenderResult, Scene, SplatModel, View
    from splatwizard_core.tooling import ResolvedConfig, Session


@dataclass(frozen=True)
class Drawing:
    """A model on its device, the scene whose cameras see it, and how its file wants it drawn.

    options     with the background of the scene
    """

    model: SplatModel
    scene: Scene
    rasterizer: NegotiatedRasterizer
    options: RasterOptions
    device: torch.device

    def render(self, camera: Camera, options: RasterOptions | None = None) -> RenderResult:
        """Draw one view, without gradients; `options` None: as the file asks. Raises CapabilityError."""
        result = render_view(self.model, camera.to(self.device), self.rasterizer, options or self.options)
        if isinstance(self.rasterizer, NegotiatedRasterizer):
            self.rasterizer.look(result)
        return result

    def has_surfels(self, camera: Camera) -> bool:
        """Whether what a camera sees is drawn as flat Gaussians (scales [N,2]), which have normals of their own."""
        with torch.no_grad():
            scales = self.model.gaussians(camera.to(self.device), self.rasterizer).scales
        return scales is not None and scales.shape[-1] == 2

    def views(self, which: str) -> list[View]:
        """Views of the scene: "test", "train" or "all", each name once."""
        train, test = self.scene.train, self.scene.test
        wanted = {"test": test, "train": train, "all": [*train, *test]}[which]
        return list({view.name: view for view in wanted}.values())

    @property
    def depth_ratio(self) -> float:
        """The share of the median in the depth of the surface that the model was trained with; 0 if it says none."""
        surface = getattr(self.model, "surface", None)
        return float(getattr(surface, "depth_ratio", 0.0))


def open_drawing(path: Path, session: Session, resolved: ResolvedConfig) -> Drawing:
    """Open the model of a .swz or .ply, then the scene, with what draws it.

    Raises BitstreamError, PluginError, UserInputError for a file that cannot be opened, SceneError.
    """
    found = open_subject(path, session, resolved)
    assert isinstance(found.rasterizer, NegotiatedRasterizer)  # a session has no other
    return Drawing(found.model, found.scene, found.rasterizer, found.options, session.device)


def encoded_file(directory: Path) -> Path:
    """Return the file of a run directory. Raises UserInputError."""
    found = directory / "scene.swz"
    if not found.is_file() or not (directory / "config.toml").is_file():
        raise UserInputError(
            f"{directory} is no finished run directory, it has no scene.swz and config.toml: name a file"
        )
    return found
