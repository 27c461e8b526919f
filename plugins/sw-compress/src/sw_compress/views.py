"""The cameras that decide what may go, and the others that tell what was lost."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sw_gaussians.camera_files import read_cameras
from sw_gaussians.made_up_cameras import plausible_cameras

from splatwizard_core.api import Camera, GaussianModel, SplatModel, UserInputError

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer, Scene

LEAST, MOST = {"cpu": 18, "cuda": 48}, {"cpu": 60, "cuda": 120}
"""Cameras in all that are made up, by kind of device: the fewer, the more Gaussians there are."""
DRAWN = {"cpu": 4e6, "cuda": 5e7}
"""Gaussians times cameras above which there are the fewest."""
JUDGED, HELD_OUT = 1 / 6, 1 / 6
"""Share of the cameras that choose among what others have pruned, and of those that only measure."""
WIDEST = {"cpu": 640, "cuda": 1600}
"""Width of the largest picture, pixels."""


@dataclass(frozen=True)
class Views:
    """Cameras by use, and the recipe or the file that they are of.

    fit         say what a Gaussian is worth
    judge       choose among what is left: what was pruned for some cameras looks too good to them
    held_out    only measure
    """

    recipe: str
    kind: str
    fit: list[Camera]
    judge: list[Camera]
    held_out: list[Camera]

    def as_dict(self) -> dict[str, Any]:
        """Facts for a record; the cameras as in a `cameras.json`."""
        return {
            "recipe": self.recipe, "kind": self.kind,
            **{name: [_listed(camera) for camera in getattr(self, name)] for name in ("fit", "judge", "held_out")},
        }  # fmt: skip


def views_of_file(path: Path) -> Views:
    """Cameras of a file, at least 3. Raises SceneError, UserInputError."""
    found = read_cameras(path).cameras
    if len(found) < 3:
        raise UserInputError(f"{path}: {len(found)} cameras; at least 3 are needed, of which 2 are set aside")
    aside = max(1, round(len(found) * HELD_OUT))
    places = set(_even(len(found), 2 * aside))
    chosen = [camera for i, camera in enumerate(found) if i in places]
    rest = [camera for i, camera in enumerate(found) if i not in places]
    return Views(path.name, "given", rest, chosen[::2], chosen[1::2])


def training_views(model: SplatModel, scene: Scene) -> Views:
    """Some training cameras of a scene, evenly spread: as many as would be made up."""
    cameras = [view.camera for view in scene.train]
    found = [cameras[i] for i in _even(len(cameras), min(_usual(model), len(cameras)))]
    judge = set(_even(len(found), max(1, round(len(found) * JUDGED))))
    fit = [camera for i, camera in enumerate(found) if i not in judge]
    return Views(scene.name, "training", fit or found, [found[i] for i in sorted(judge)], [])


def _usual(model: SplatModel) -> int:
    device = model.device.type
    return min(max(int(DRAWN[device] / model.num_rows), LEAST[device]), MOST[device])


def made_up_views(model: GaussianModel, rasterizer: Rasterizer, count: int | None) -> Views:
    """Cameras from the scene alone, `count` in all; None: by the number of Gaussians."""
    device, count = model.device.type, _usual(model) if count is None else count
    held_out, judge = max(1, round(count * HELD_OUT)), max(1, round(count * JUDGED))
    made = plausible_cameras(
        model, rasterizer, fit=count - judge - held_out, held_out=judge + held_out, widest=WIDEST[device]
    )
    others = made.held_out
    if len(others) < 2:
        raise UserInputError("only one view of the scene could be made up beside others: give cameras in a file")
    picked = set(_even(len(others), max(1, len(others) // 2)))
    return Views(
        made.recipe, made.kind, made.fit,
        [camera for i, camera in enumerate(others) if i not in picked],
        [camera for i, camera in enumerate(others) if i in picked],
    )  # fmt: skip


def _even(count: int, some: int) -> list[int]:
    """So many of 0 .. count - 1, evenly spread."""
    return [int((i + 0.5) * count / some) for i in range(some)]


def _listed(camera: Camera) -> dict[str, Any]:
    """A camera as `read_cameras` reads it."""
    return {
        "width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
        "cx": camera.cx, "cy": camera.cy, "position": camera.center.tolist(), "rotation": camera.R.T.tolist(),
    }  # fmt: skip
