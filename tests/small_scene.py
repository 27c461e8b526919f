"""Three small views of ten points, and ten Gaussians: enough for the pure-torch rasterizer."""

from __future__ import annotations

import numpy as np
import torch

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View

WIDTH, HEIGHT = 16, 12


def small_scene() -> Scene:
    """Two views to train, one to test, with noise as pictures."""
    rng = np.random.default_rng(0)
    up = torch.tensor([0.0, 1.0, 0.0])
    views = []
    for i, angle in enumerate((0.0, 0.3, 0.6)):
        eye = torch.tensor([4 * np.sin(angle), 0.0, 4 * np.cos(angle)]).float()
        camera = Camera.look_at(eye, torch.zeros(3), up, width=WIDTH, height=HEIGHT, fov_x=0.8)
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        views.append(View(camera, f"{i}.png", load=lambda pixels=pixels: pixels))
    points = torch.from_numpy(rng.uniform(-0.5, 0.5, (10, 3))).float()
    return Scene("tiny", views[:2], views[2:], PointCloud(points, torch.full((10, 3), 0.6)), Protocol("tiny"))


def ten_gaussians(scene: Scene) -> GaussianModel:
    """Ten Gaussians at the points of a scene, but for the first, which is behind every camera."""
    means = scene.points.xyz.clone()
    means[0] = torch.tensor([0.0, 0.0, 50.0])
    generator = torch.Generator().manual_seed(1)
    return GaussianModel.from_tensors(
        means,
        torch.randn(10, 1, 3, generator=generator),
        torch.randn(10, 3, 3, generator=generator),
        torch.linspace(-2, 2, 10),
        torch.full((10, 3), -1.5),
        torch.randn(10, 4, generator=generator),
    )
