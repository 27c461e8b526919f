"""The procedural scene as a dataset family: `demo`, or `demo:tiny` for tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from splatwizard_core.api import Scene, SceneError, SceneOptions
from sw_datasets.demo.synthetic import SIZES, make_scene
from sw_datasets.families import DEMO
from sw_datasets.pictures import fitted_size
from sw_datasets.rules import rules_for, unused_option_warnings

UNUSED_OPTIONS = ("principal_point", "mask_background", "legacy_8bit_composite", "exif_turn", "init_points")
"""Scene options that change nothing: pictures are drawn, and the size of the scene sets the number of points."""


class DemoDataset:
    """The procedural scene, asked for by the name `demo`; no folder is of this family."""

    def detect(self, path: Path) -> float:
        """Return 0: the scene is not read from a folder."""
        return 0.0

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Draw the scene of a size, `demo` or `tiny`. Raises SceneError for another one, ConfigError for `images`."""
        variant = str(path)
        if variant not in SIZES:
            raise SceneError(f"there is no demo scene '{variant}': use demo or demo:tiny")
        size = SIZES[variant]
        rules = rules_for(replace(DEMO, split=f"every{size.test_every}"), variant, options)
        width, height = fitted_size(size.width, size.height, rules.resolution)
        scene = make_scene(
            replace(size, width=width, height=height),
            name="demo" if variant == "demo" else f"demo-{variant}",
            init_seed=options.seed,
            background=rules.background,
            split=rules.split,
            source_size=(size.width, size.height),
            resolution=rules.resolution,
            points=rules.points,
        )
        scene.warnings += unused_option_warnings(options, UNUSED_OPTIONS, DEMO)
        return scene
