"""The procedural scene as a dataset family: `demo`, or `demo:tiny` for tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from splatwizard_core.errors import SceneError
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.images import fitted_size
from splatwizard_core.scene.scene import Scene
from splatwizard_core.scene.synthetic import SIZES, make_scene


class DemoDataset:
    """No folder is ever of this family; the name `demo` asks for it."""

    def detect(self, path: Path) -> float:
        """0: the scene is not read from anywhere."""
        return 0.0

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """path: `demo` or `tiny`, the name of a size. Raises SceneError for another one."""
        variant = str(path)
        if variant not in SIZES:
            raise SceneError(f"there is no demo scene '{variant}': use demo or demo:tiny")
        size = SIZES[variant]
        source_size = (size.width, size.height)
        width, height = fitted_size(size.width, size.height, options.resolution)
        size = replace(size, width=width, height=height)
        if options.split is None and options.test_every != SceneOptions.test_every:
            size = replace(size, test_every=options.test_every)
        return make_scene(
            size,
            name="demo" if variant == "demo" else f"demo-{variant}",
            init_seed=options.seed,
            background=options.background or "black",
            split=options.split,
            source_size=source_size,
            resolution=options.resolution,
        )
