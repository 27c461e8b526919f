"""Makes a Scene of what a loader has read: the checks and the split that every family shares."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import torch

from splatwizard_core.api import PointCloud, Protocol, Scene, SceneError, View
from sw_datasets.splits import split_views

FARTHEST = 1e6  # pixels: focal lengths and principal points beyond it overflow float32 when they are projected with


def assemble_scene(
    name: str,
    views: Sequence[View],
    *,
    points: PointCloud | None,
    protocol: Protocol,
    path: str | None = None,
    own_split: tuple[Sequence[View], Sequence[View]] | None = None,
    ground_truth: dict[str, Any] | None = None,
    warnings: Sequence[str] = (),
) -> Scene:
    """Make a checked scene, split by `protocol.split` over the views sorted by name.

    own_split   (train, test) that the files themselves define, taken when the split is "file"

    Non-finite points are dropped with a warning that counts them. Raises SceneError in one line for a pose that is
    not finite (naming the image), equal names, an empty half of the split, and points none of which is finite.
    """

    def refused(reason: object) -> SceneError:
        return SceneError(f"{path or name}: {reason}", path=path)

    notes = list(warnings)
    views = sorted(views, key=lambda view: view.name)
    if not views:
        raise refused("no views; a scene needs at least 2")
    for view in views:
        if (fault := _camera_fault(view)) is not None:
            raise refused(fault)
    repeated = [n for n, count in Counter(v.name for v in views).items() if count > 1]
    if repeated:
        raise refused(f"image name '{repeated[0]}' occurs more than once")
    if protocol.split == "file":
        if own_split is None:
            raise refused("split 'file', but the scene brings no split; use 'every8' or 'all'")
        train, test = list(own_split[0]), list(own_split[1])
        if not train or not test:
            raise refused(f"its own split has {len(train)} views to train and {len(test)} to test; both need 1")
    else:
        try:
            train, test = split_views(views, protocol.split)
        except SceneError as error:
            raise refused(error) from error
    if points is not None:
        finite = points.finite()
        bad = len(points) - len(finite)
        if bad and bad == len(points):
            raise refused(f"none of the {bad} points is finite; the reconstruction is broken")
        if bad:
            notes.append(f"dropped {bad} of {len(points)} points that are not finite")
        points = finite
    scene = Scene(name, train, test, points, protocol, path, dict(ground_truth or {}), notes)
    if scene.radius == 0:
        reason = "there is one training camera" if len(train) == 1 else "all training cameras stand at one place"
        notes.append(f"{reason}: the scene extent is set to 1.0, which scales learning rates and thresholds")
    return scene


def _camera_fault(view: View) -> str | None:
    """Reason why the camera of a view cannot be used, or None."""
    camera = view.camera
    if not (torch.isfinite(camera.R).all() and torch.isfinite(camera.tau).all()):
        return f"the pose of image '{view.name}' is not finite (NaN or infinite)"
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
    if not all(abs(x) <= FARTHEST for x in numbers) or min(camera.fx, camera.fy) < 1 / FARTHEST:
        return f"the intrinsics of image '{view.name}' make no sense: fx, fy, cx, cy = {numbers}"
    return None
