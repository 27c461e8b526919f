"""Makes a Scene of what a loader has read: the checks and the split that every family shares."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import Camera, ConfigError, PointCloud, Protocol, Scene, SceneError, View
from sw_datasets.name_lists import NameLists, lists_beside, lists_id, read_lists, split_by_lists
from sw_datasets.splits import holds_out_places, is_rule, split_scene

FAR_OUT = 100.0
"""Distance of the cameras from the origin, in sizes of the scene, from which they are moved: float32 coordinates there
have steps of 1e-5 of the scene, a hundredth of a pixel of a picture of 1600."""
SAMPLED_POINTS, SAMPLED_CAMERAS = 2000, 32
MIN_POINTS = 100  # of fewer it says nothing that cameras do not see them
NEAR = 0.02
"""Near plane of a small scene, in median depths of its points; 3DGS has 0.2 in scenes of depth 5 to 10."""
FARTHEST_PLACE = 1e12  # scene units: squared distances beyond it come near to the end of float32
FARTHEST = 1e6  # pixels: focal lengths and principal points beyond it overflow float32 when they are projected with


def assemble_scene(
    name: str,
    views: Sequence[View],
    *,
    points: PointCloud | None,
    train_points: Callable[[Sequence[View]], PointCloud] | None = None,
    protocol: Protocol,
    path: str | None = None,
    own_split: tuple[Sequence[View], Sequence[View]] | None = None,
    own_lists: NameLists | None = None,
    finds_lists: bool = False,
    ground_truth: dict[str, Any] | None = None,
    warnings: Sequence[str] = (),
) -> Scene:
    """Make a checked scene in float32, split by `protocol.split` over the views sorted by name.

    views, points   may have poses and positions in float64: those far from the origin are moved to a local one, which
                    the scene keeps (`Scene.origin`)
    train_points    gives those of the start points that these training views alone would bring; None: nobody knows
    own_split   (train, test) that the files themselves define, taken when the split is "file"
    own_lists   names of views in the scene's own files, taken like train.txt and test.txt beside it
    finds_lists the scene's own lists are taken before `protocol.split`, which the user did not ask for

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
    folder = None if path is None else Path(path)
    try:
        lists = own_lists
        if (named := split_file(protocol.split, folder)) is not None:
            lists = read_lists(named)
        elif own_split is not None:
            lists = None
        elif lists is None and folder is not None and folder.is_dir():
            lists = lists_beside(folder)
        if lists is not None and named is None and not finds_lists and protocol.split != "file":
            notes.append(f"{lists.source} of the scene is not used (split = file takes it)")
            lists = None
        if lists is not None:
            train, test, told_of_lists = split_by_lists(views, lists)
            notes += told_of_lists
            protocol = replace(protocol, split=lists_id(train, test))
        elif protocol.split == "file":
            if own_split is None:
                raise SceneError("split 'file', but the scene brings no split; use 'every8', 'all' or a file of names")
            train, test = list(own_split[0]), list(own_split[1])
            if not train or not test:
                raise SceneError(f"its own split has {len(train)} views to train and {len(test)} to test; both need 1")
        else:
            train, test, rule = split_scene(views, protocol.split, own_split)
            protocol = replace(protocol, split=rule)
    except SceneError as error:
        raise refused(error) from error
    protocol, kept = points_of_training(protocol, points, train, train_points)
    if points is not None and kept is not points:
        if not len(kept):
            raise refused(f"no training view saw any of the {len(points):,} start points; points = all uses them")
        if len(kept) < len(points):
            notes.append(f"{len(kept):,} of {len(points):,} start points are used: those that training views saw")
        points = kept
    elif protocol.points == "all" and points is not None:
        notes.append("the start points may be of the held-out views too (no tracks, or points = all)")
    origin = local_origin(views, points)
    if any(origin):
        notes.append(
            f"the coordinates lie far from 0: the scene is moved to a local origin at {told(origin)} "
            "(`sw export --world` moves models back)"
        )
    for view in views:
        view.camera = moved(view.camera, origin)
    if points is not None:
        points = PointCloud((points.xyz.double() - torch.tensor(origin, dtype=torch.float64)).float(), points.rgb)
        finite = points.finite()
        bad = len(points) - len(finite)
        if bad and bad == len(points):
            raise refused(f"none of the {bad} points is finite; the reconstruction is broken")
        if bad:
            notes.append(f"dropped {bad} of {len(points)} points that are not finite")
        points = finite
        depths = depths_seen([view.camera for view in views], points.xyz)
        blind = sum(not len(each) for each in depths)
        if len(points) >= MIN_POINTS and 2 * blind > len(depths):
            notes.append(
                f"{blind} of {len(depths)} cameras see none of the start points: poses or points may have other axes "
                "than this layout has (OpenCV or OpenGL, camera to world or back)"
            )
        near = near_plane(depths, views[0].camera.near)
        if near is not None:
            notes.append(
                f"most points lie nearer to the cameras than {views[0].camera.near:g}, where nothing is drawn: the "
                f"near plane is moved to {near:.3g} (other programs need a larger scene)"
            )
            for view in views:
                view.camera = replace(view.camera, near=near)
    scene = Scene(name, train, test, points, protocol, path, dict(ground_truth or {}), notes, origin)
    if scene.radius == 0:
        reason = "there is one training camera" if len(train) == 1 else "all training cameras stand at one place"
        notes.append(f"{reason}: the scene extent is set to 1.0, which scales learning rates and thresholds")
    return scene


def points_of_training(
    protocol: Protocol,
    points: PointCloud | None,
    train: Sequence[View],
    train_points: Callable[[Sequence[View]], PointCloud] | None,
) -> tuple[Protocol, PointCloud | None]:
    """The protocol with its rule for start points, and the points that it leaves.

    Without a wish (`protocol.points`), a split that holds out places keeps those that training views saw, where that is
    known. Raises ConfigError where it is asked for and not known.
    """
    wish = protocol.points or ("train" if holds_out_places(protocol.split) else "")
    if wish == "train" and train_points is None and points is not None:
        if protocol.points:
            raise ConfigError(
                "points = train-tracks: nothing tells which views saw the start points (COLMAP's points3D does)",
                key="points",
            )
        wish = "all"
    if wish == "all" and not holds_out_places(protocol.split):
        wish = ""
    protocol = replace(protocol, points=wish)
    if wish != "train" or points is None or train_points is None:
        return protocol, points
    return protocol, train_points(train)


def split_file(split: str, scene: Path | None) -> Path | None:
    """The file of names that a split is, where it is no rule: as it is, or in the scene's folder."""
    if is_rule(split):
        return None
    places = [Path(os.path.expanduser(split)), *([scene / split] if scene is not None else [])]
    return next((place for place in places if os.path.isfile(place)), None)


def local_origin(views: Sequence[View], points: PointCloud | None) -> tuple[float, float, float]:
    """The point of the world that becomes the origin, in whole steps of about the scene's size; 0 for most scenes.

    It follows from the poses of all views, whatever the split, and from the points.
    """
    centres = torch.stack([centre_of(view.camera) for view in views])
    middle = centres.median(dim=0).values
    size = (centres - middle).norm(dim=1).max().item()
    if points is not None and len(points):
        reach = (points.xyz.double() - middle).norm(dim=1)
        size = max(size, reach[torch.isfinite(reach)].median().item() if torch.isfinite(reach).any() else 0.0)
    distance = middle.norm().item()
    if size <= 16 * torch.finfo(views[0].camera.tau.dtype).eps * distance:  # all stand at one place
        size = 1.0
    if not math.isfinite(distance) or distance < FAR_OUT * size:
        return (0.0, 0.0, 0.0)
    step = 10.0 ** min(math.floor(math.log10(size)), 0)
    x, y, z = (round(round(value / step) * step, 9) for value in middle.tolist())
    return (x, y, z)


def depths_seen(cameras: Sequence[Camera], points: Tensor) -> list[Tensor]:
    """For each camera the depths of the points that lie in its picture; of many cameras and points a sample."""
    some = points[:: max(1, len(points) // SAMPLED_POINTS)].double()
    depths = []
    for c in cameras[:: max(1, len(cameras) // SAMPLED_CAMERAS)]:
        t = some @ c.R.double().T + c.tau.double()
        u, v = c.fx * t[:, 0] / t[:, 2] + c.cx, c.fy * t[:, 1] / t[:, 2] + c.cy
        depths.append(t[(t[:, 2] > 0) & (u >= 0) & (u < c.width) & (v >= 0) & (v < c.height), 2])
    return depths


def near_plane(depths: Sequence[Tensor], usual: float) -> float | None:
    """A near plane for scenes so small that most of their points would not be drawn; None: the usual one serves."""
    seen = torch.cat(depths) if depths else torch.zeros(0)
    if not len(seen) or (middle := seen.median().item()) > usual:
        return None
    return float(f"{NEAR * middle:.2g}")


def centre_of(camera: Camera) -> Tensor:
    """Camera centre in the world, [3] float64."""
    return -(camera.R.double().T @ camera.tau.double())


def moved(camera: Camera, origin: tuple[float, float, float]) -> Camera:
    """The camera, in float32, of a world whose origin is at `origin` of the old one."""
    if not any(origin) and camera.tau.dtype == torch.float32:
        return camera
    tau = camera.tau.double()
    if any(origin):
        tau = tau + camera.R.double() @ torch.tensor(origin, dtype=torch.float64)
    return replace(camera, R=camera.R.float(), tau=tau.float())


def told(origin: tuple[float, float, float]) -> str:
    """The coordinates in as few digits as say them."""
    return "(" + ", ".join(f"{value:.12g}" for value in origin) + ")"


def _camera_fault(view: View) -> str | None:
    """Reason why the camera of a view cannot be used, or None."""
    camera = view.camera
    if not (torch.isfinite(camera.R).all() and torch.isfinite(camera.tau).all()):
        return f"the pose of image '{view.name}' is not finite (NaN or infinite)"
    if max(camera.R.abs().max(), camera.tau.abs().max()) > FARTHEST_PLACE:
        return f"the pose of image '{view.name}' makes no sense: it lies farther than {FARTHEST_PLACE:g} from 0"
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
    if not all(abs(x) <= FARTHEST for x in numbers) or min(camera.fx, camera.fy) < 1 / FARTHEST:
        return f"the intrinsics of image '{view.name}' make no sense: fx, fy, cx, cy = {numbers}"
    return None
