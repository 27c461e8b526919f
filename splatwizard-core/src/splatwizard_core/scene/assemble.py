"""From what a loader read to a Scene: the checks and the split that every family shares."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import torch

from splatwizard_core.errors import SceneError
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.scene.splits import split_views


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
    """A checked scene, split by `protocol.split` over the views sorted by name.

    own_split   (train, test) that the files themselves define, taken when the split is "file"

    Non-finite points are dropped with a warning that counts them. Raises SceneError in one line for a pose that is
    not finite (naming the image), equal names, an empty half of the split, and points none of which is finite.
    """
    where = path or name
    notes = list(warnings)
    views = sorted(views, key=lambda view: view.name)
    if not views:
        raise SceneError(f"{where}: no views; a scene needs at least 2", path=path)
    for view in views:
        _check_camera(view, where, path)
    repeated = [n for n, count in Counter(v.name for v in views).items() if count > 1]
    if repeated:
        raise SceneError(f"{where}: image name '{repeated[0]}' occurs more than once", path=path)
    if protocol.split == "file":
        if own_split is None:
            raise SceneError(f"{where}: split 'file', but the scene brings no split; use 'every8' or 'all'", path=path)
        train, test = list(own_split[0]), list(own_split[1])
        if not train or not test:
            raise SceneError(
                f"{where}: its own split has {len(train)} views to train and {len(test)} to test; both need 1",
                path=path,
            )
    else:
        try:
            train, test = split_views(views, protocol.split)
        except SceneError as error:
            raise SceneError(f"{where}: {error}", path=path) from error
    points, dropped = _finite_points(points, where, path)
    notes += dropped
    scene = Scene(name, train, test, points, protocol, path, dict(ground_truth or {}), notes)
    centers = torch.stack([view.camera.center.double().cpu() for view in train])
    if (centers == centers[0]).all():
        reason = "there is one training camera" if len(train) == 1 else "all training cameras stand at one place"
        notes.append(f"{reason}: the scene extent is set to 1.0, which scales learning rates and thresholds")
    return scene


def _check_camera(view: View, where: str, path: str | None) -> None:
    camera = view.camera
    if not (torch.isfinite(camera.R).all() and torch.isfinite(camera.tau).all()):
        raise SceneError(f"{where}: the pose of image '{view.name}' is not finite (NaN or infinite)", path=path)
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
    if not all(math.isfinite(x) for x in numbers) or camera.fx <= 0 or camera.fy <= 0:
        raise SceneError(
            f"{where}: the intrinsics of image '{view.name}' make no sense: fx, fy, cx, cy = {numbers}", path=path
        )


def _finite_points(points: PointCloud | None, where: str, path: str | None) -> tuple[PointCloud | None, list[str]]:
    if points is None:
        return None, []
    finite = torch.isfinite(points.xyz).all(dim=1)
    if points.rgb is not None:
        finite &= torch.isfinite(points.rgb).all(dim=1)
    bad = int((~finite).sum())
    if not bad:
        return points, []
    if bad == len(points):
        raise SceneError(f"{where}: none of the {bad} points is finite; the reconstruction is broken", path=path)
    kept = PointCloud(points.xyz[finite], None if points.rgb is None else points.rgb[finite])
    return kept, [f"dropped {bad} of {len(points)} points that are not finite"]
