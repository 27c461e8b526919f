"""Small scenes on disk, made by the test itself."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from sw_datasets.loaders.colmap_model import (
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    write_model,
)

from splatwizard_core.plugins import load_plugins
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene

PINHOLE = ColmapCamera(1, "PINHOLE", 32, 24, (30.0, 30.0, 16.0, 12.0))


@dataclass
class ColmapFolder:
    """A COLMAP scene to be spoilt and written: cameras look along +z, one 3D point in front of each."""

    root: Path
    names: list[str] = field(default_factory=lambda: [f"{i:03d}.png" for i in range(10)])
    camera: ColmapCamera = PINHOLE
    picture_size: tuple[int, int] = (32, 24)
    num_points: int = 5
    text: bool = False
    pictures: str = "images"
    sparse: str = "sparse/0"
    nan_pose_of: str | None = None
    more_cameras: list[ColmapCamera] = field(default_factory=list)
    """Image i has camera i of [camera, *more_cameras], over and over; its picture has that camera's size."""

    def model(self) -> ColmapModel:
        images = {}
        for i, name in enumerate(self.names, 1):
            q = (1.0, 0.0, 0.0, 0.0) if name != self.nan_pose_of else (float("nan"), 0.0, 0.0, 0.0)
            images[i] = ColmapImage(
                i, q, (-float(i), 0.0, 0.0), self.camera_of(i - 1).id, name, np.array([[1.5, 2.5]]), np.array([1])
            )
        n = self.num_points
        points = ColmapPoints(
            ids=np.arange(1, n + 1),
            xyz=np.stack([np.arange(n, dtype=float), np.zeros(n), np.full(n, 5.0)], axis=1),
            rgb=np.full((n, 3), 51, np.uint8),
            error=np.full(n, 0.5),
            track_start=np.arange(n + 1),
            track=np.stack([np.ones(n, np.int32), np.zeros(n, np.int32)], axis=1),
        )
        return ColmapModel({camera.id: camera for camera in [self.camera, *self.more_cameras]}, images, points)

    def camera_of(self, index: int) -> ColmapCamera:
        cameras = [self.camera, *self.more_cameras]
        return cameras[index % len(cameras)]

    def write(self) -> Path:
        write_model(self.model(), self.root / self.sparse, text=self.text)
        for i, name in enumerate(self.names):
            file = self.root / self.pictures / name
            file.parent.mkdir(parents=True, exist_ok=True)
            camera = self.camera_of(i)
            size = (camera.width, camera.height) if self.more_cameras else self.picture_size
            Image.new("RGB", size, (i, 2 * i, 3 * i)).save(file)
        return self.root


@pytest.fixture(scope="session")
def plugins():
    return load_plugins()


@pytest.fixture
def load(plugins):
    """load(path, **options) -> Scene."""

    def load_it(path, **options):
        return load_scene(str(path), SceneOptions(**options), plugins)

    return load_it


@pytest.fixture
def colmap_folder(tmp_path):
    """A ColmapFolder to adjust, then .write()."""
    return ColmapFolder(tmp_path / "garden")


@pytest.fixture(scope="session")
def tiny(plugins):
    return load_scene("demo:tiny", SceneOptions(), plugins)


@pytest.fixture(scope="session")
def test_data():
    """data("fox") -> its folder; skips where the development data is absent."""
    beside = Path(__file__).resolve().parents[4] / "shared" / "data"
    root = Path(os.environ.get("SPLATWIZARD_TEST_DATA", beside))

    def data(name: str) -> Path:
        if not (root / name).is_dir():
            pytest.skip(f"no development data: {root / name} (set SPLATWIZARD_TEST_DATA)")
        return root / name

    return data
