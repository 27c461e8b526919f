"""NeRF-Synthetic scenes: transforms_train.json and transforms_test.json beside RGBA pictures."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from splatwizard_core.api import PointCloud, Scene, SceneError, SceneOptions, View
from sw_datasets.assemble import assemble_scene
from sw_datasets.families import BLENDER
from sw_datasets.image_checks import Gate
from sw_datasets.loaders.transforms import Frames, read_frames, unused_keys
from sw_datasets.rules import Rules, rules_for, unused_option_warnings
from sw_datasets.start_points import cloud_beside, points_in_sight, random_points, read_cloud, share_in_sight

FEWEST_IN_SIGHT = 0.1
"""Share of the random points that cameras of a Blender scene see at least; else they are laid where these look."""


class BlenderDataset:
    """Blender scenes: camera-to-world matrices in OpenGL axes, split by file, white background by default."""

    def detect(self, path: Path) -> float:
        """0.5 with transforms_train.json, else 0."""
        return 0.5 if has_blender_layout(path) else 0.0

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Read poses and the sizes of the pictures; no pixel is decoded. Raises SceneError in one line."""
        return load_blender(path, rules_for(BLENDER, path.resolve().name, options), options)


def has_blender_layout(path: Path) -> bool:
    """Whether a folder is a Blender scene."""
    return os.path.isfile(path / "transforms_train.json")


def load_blender(path: Path, rules: Rules, options: SceneOptions) -> Scene:
    """The scene of a Blender folder, read by `rules`. Raises SceneError in one line."""
    if not has_blender_layout(path):
        raise SceneError(f"{path / 'transforms_train.json'} is missing: {path} is no Blender scene", path=str(path))
    gate = Gate(path, rules, always_cut=True)
    train = read_frames(path, "transforms_train.json", gate)
    test = Frames([])
    warnings = train.warnings
    if (path / "transforms_test.json").is_file():
        test = read_frames(path, "transforms_test.json", gate)
        warnings += test.warnings
    elif rules.split == "file" and options.split is None:
        rules = replace(rules, split="every8")
        warnings.append(f"there is no transforms_test.json: the training views are split by {rules.split}")
    unused = (train.unused | test.unused) - {"rotation"}  # Blender's: the turn of the camera between two frames
    warnings += unused_keys("transforms_train.json", unused)
    published, views = rules.family.views, (len(train.views), len(test.views))
    if rules.scene is not None and published is not None and views != published:
        warnings.append(
            f"{rules.family.title} has {published[0]} training and {published[1]} test views a scene, this folder "
            f"{views[0]} and {views[1]}: figures are not comparable with published ones"
        )
    warnings += gate.warnings()
    points = _start_points(path, train, options, warnings)
    if options.mask_background is False:  # alpha always cuts these pictures out
        warnings += unused_option_warnings(options, ("mask_background",), rules.family)
    return assemble_scene(
        path.resolve().name,
        train.views + test.views,
        points=points,
        train_points=None if train.cloud or cloud_beside(path) else lambda views: _random_points(views, options)[0],
        protocol=rules.protocol("rgba", masked=gate.masked, turned=gate.turned),
        path=str(path),
        own_split=(train.views, test.views),
        warnings=warnings,
    )


def _start_points(path: Path, train: Frames, options: SceneOptions, warnings: list[str]) -> PointCloud:
    """Read the points that the training file names, or those beside it, or draw random ones; extends `warnings`."""
    cloud = train.cloud or cloud_beside(path)
    if cloud is not None:
        points = read_cloud(cloud)
        warnings.append(f"the {len(points):,} start points are those of {cloud.name}")
        return points
    points, told = _random_points(train.views, options)
    warnings += told
    return points


def _random_points(views: Sequence[View], options: SceneOptions) -> tuple[PointCloud, list[str]]:
    """(random points, warnings): in the cube that Blender scenes fill, or where the cameras look instead."""
    points = random_points(options.init_points, options.seed)
    cameras = [view.camera for view in views]
    if cameras and share_in_sight(points.xyz[:1000], cameras) < FEWEST_IN_SIGHT:
        return points_in_sight(cameras, options.init_points, options.seed), [
            "the cameras do not look at the cube [-1.3, 1.3]^3, which Blender scenes fill: the "
            f"{options.init_points:,} random start points are laid where they look"
        ]
    return points, []
