"""A trained little scene that the tests of the package share."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from sw_kit import short_training

from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import apply_overrides
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.streams import stream
from sw_cat_3dgs.config import CatConfig
from sw_cat_3dgs.method import Cat3DGS

sys.path.insert(0, str(Path(__file__).parent))  # for plane_lists

SMALL = {
    "feature_dim": 8,
    "num_offsets": 4,
    "hidden": 12,
    "voxel_size": 0.05,
    "context.channels": 4,
    "context.hidden": 12,
    "context.slices": [2, 6],
    "context.slice_hidden": 8,
    "context.neighbors": 20,
}
PLAN = {
    **SMALL,
    "iterations": 180,
    "lr.max_steps": 180,
    "growth.start": 20,
    "growth.pause_start": 30,
    "growth.pause_end": 40,
    "growth.stop": 80,
    "growth.start_stat": 5,
    "growth.interval": 10,
    "phases.quantize": 30,
    "phases.triplane": 60,
    "phases.warmup": 80,
    "phases.scene": 86,
    "phases.planes": 94,
    "rate_term.sample": 0.2,
    "rate_term.lambda_": 0.004,
    "context.start": "statistics",  # these plans are short
}


def make_method(**values) -> Cat3DGS:
    """Of a little configuration; keys with __ for the dots."""
    values = {key.replace("__", "."): value for key, value in values.items()}
    return Cat3DGS(load_plugins(), apply_overrides(CatConfig(), {**PLAN, **values}, source="test"))


@pytest.fixture(scope="session")
def method():
    return make_method


@pytest.fixture(scope="session")
def scene() -> Scene:
    return short_training.demo(points=400)


@pytest.fixture(scope="session")
def rasterizer() -> NegotiatedRasterizer:
    return NegotiatedRasterizer(load_plugins(), device="cpu")


@pytest.fixture(scope="session")
def train(scene, rasterizer):
    def run(directory=None, stop_after=None, **values):
        made = make_method(**values)
        return short_training.train(made, scene, rasterizer, directory=directory, stop_after=stop_after)

    return run


@pytest.fixture(scope="session")
def trained(train):
    return train().model


@pytest.fixture
def little_scene() -> Scene:
    """Three cameras around forty points; no pictures."""
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    up, target = torch.tensor([0.0, 1.0, 0.0]), torch.zeros(3)
    eyes = torch.tensor([[0.0, 0, -4], [3.0, 0, -3], [-3.0, 1, -3]])
    views = [
        View(Camera.look_at(e, target, up, width=24, height=24, fov_x=1.0), f"{i}.png") for i, e in enumerate(eyes)
    ]
    return Scene("tiny", views, views[:1], PointCloud(points, points + 0.5), Protocol("test", background="black"))


@pytest.fixture
def begun(little_scene):
    """(stage, model, optimizer) at step 0 of a little configuration."""

    def begin(**values):
        made = make_method(**values)
        (stage,) = made.stages()
        model = made.create_model(little_scene, stream(0, "init"))
        context = SimpleNamespace(model=model, scene=little_scene, generator=lambda name: stream(3, name))
        model = stage.begin(context)
        return stage, model, stage.create_optimizer(model, little_scene)

    return begin
