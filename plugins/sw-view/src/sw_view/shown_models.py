"""Models as a viewer shows them: pictures from any camera, their Gaussians, and a line about them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from splatwizard_core.api import Camera
from sw_view.entries import Opened
from sw_view.frames import Pixels
from sw_view.mode_pictures import mode_picture
from sw_view.shown_gaussians import ShownGaussians, shown_gaussians


@dataclass(frozen=True)
class ShownModel:
    """A model that a viewer shows.

    draw        (camera, mode of `mode_pictures.MODES`) -> [H,W,3]; may raise CapabilityError
    gaussians   (camera) -> Gaussians that a browser draws by itself
    told        () -> a line about it: counts, bytes, what draws it
    """

    draw: Callable[[Camera, str], Pixels]
    gaussians: Callable[[Camera], ShownGaussians]
    told: Callable[[], str]


def shown_model(opened: Opened) -> ShownModel:
    """Return what a viewer needs of an opened model."""
    drawing = opened.drawing

    def told() -> str:
        drawn_by = ", ".join(sorted(set(drawing.rasterizer.drawn_by.values())))
        return f"{opened.told}; drawn by {drawn_by} on {drawing.device}" if drawn_by else opened.told

    return ShownModel(
        draw=lambda camera, mode: mode_picture(drawing, camera, mode),
        gaussians=lambda camera: shown_gaussians(drawing.model, camera, drawing.rasterizer),
        told=told,
    )
