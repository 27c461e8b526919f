"""Three small views of ten points, ten Gaussians, and a few steps of training with the pure-torch rasterizer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.pipeline import TrainingRun
from splatwizard_core.training.stage import CameraIterator, Stage
from splatwizard_core.training.tasks import TaskContext

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


def context_of(model: GaussianModel, scene: Scene) -> TaskContext:
    """What tasks are given between two steps."""
    optimizer = SplatOptimizer(model, [ParamGroup("opacity_logits", 0.05)])
    cameras = CameraIterator(scene.train)
    return TaskContext(PipelineParams(), OptimizationParams(), model, scene, optimizer, cameras, ReferenceRasterizer())


def train_with(stages: Sequence[Stage], make_model: Callable[[], SplatModel], scene: Scene, on_step: Any = None) -> Any:
    """Train all stages, without checkpoints; returns the model."""
    training = TrainingRun(
        stages, make_model, scene, PipelineParams(), ReferenceRasterizer(),
        directory=None, identity={}, trained=lambda name: pytest.fail(f"asked for {name}"), on_step=on_step,
    )  # fmt: skip
    return training.train().model
