"""A scene of a few pixels, Gaussians on its points, and a training of them."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingRun

WIDTH, HEIGHT = 12, 10
ORIGIN, UP = torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])


def make_scene(views=6, points=40, radius=3.0):
    generator = torch.Generator().manual_seed(7)
    made = []
    for i in range(views):
        angle = 2 * math.pi * i / views
        eye = torch.tensor([radius * math.cos(angle), radius * math.sin(angle), 1.0])
        pixels = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=generator).numpy().astype(np.uint8)
        camera = Camera.look_at(eye, ORIGIN, UP, width=WIDTH, height=HEIGHT, fov_x=0.8)
        made.append(View(camera, f"view{i}.png", lambda pixels=pixels: pixels))
    cloud = PointCloud(torch.rand(points, 3, generator=generator) - 0.5, torch.rand(points, 3, generator=generator))
    return Scene("toy", made, made[:1], cloud, Protocol("toy"))


def make_model(scene):
    return gaussians_from_points(scene.points, max_sh_degree=1)


@pytest.fixture(autouse=True)
def one_thread():
    """Tensors of a few hundred numbers: threads only cost."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def rasterizer():
    return NegotiatedRasterizer(load_plugins(), device="cpu")


@pytest.fixture
def toy(rasterizer):
    """The scene, `make_scene()`, `make_model(scene)`, and `train(stages, **options)`, which runs TrainingRun."""
    scene = make_scene()

    def train(stages, *, scene=scene, model=None, ppl=None, **options):
        create_model = model or (lambda: make_model(scene))
        options = {"directory": None, "identity": {"method": "toy"}, "trained": None, **options}
        ppl = ppl or PipelineParams(checkpoint_every=1000)
        return TrainingRun(stages, create_model, scene, ppl, rasterizer, **options).train()

    return SimpleNamespace(scene=scene, make_scene=make_scene, make_model=make_model, train=train)
