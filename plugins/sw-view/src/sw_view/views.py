"""Views drawn one after the other into a folder: the picture of each, and its maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from splatwizard_core.api import track
from splatwizard_core.tooling import png_names, save_png
from sw_view.maps import maps_of

if TYPE_CHECKING:
    from splatwizard_core.api import View
    from sw_view.drawing import Drawing
    from sw_view.map_files import MapFiles


def draw_views(drawing: Drawing, views: Sequence[View], folder: Path, maps: MapFiles) -> list[str]:
    """Draw views as 8-bit PNG into `folder`, and the maps that `maps` asks for; returns the names of the pictures.

    Raises CapabilityError, before anything is drawn, where no rasterizer offers the maps.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = png_names([view.name for view in views])
    options = maps.request.options(drawing.options)
    with track("render", total=len(views), unit="views") as bar:
        for view, name in zip(views, names, strict=True):
            result = drawing.render(view.camera, options)
            save_png(result.image.cpu(), folder / name)
            if not maps.request.is_empty:
                camera = view.camera.to(drawing.device)
                maps.add(name.removesuffix(".png"), maps_of(result, camera, maps.request))
            bar.advance()
    maps.finish()
    return names
