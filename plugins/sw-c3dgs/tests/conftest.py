"""Plugins, the rasterizer and scenes of a few Gaussians and pixels."""

from types import SimpleNamespace

import pytest
import torch

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import Protocol, Scene, View


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def plugins():
    return load_plugins()


@pytest.fixture(scope="session")
def rasterizer(plugins):
    return NegotiatedRasterizer(plugins, device="cpu")


def camera(eye, width=48, height=36):
    return Camera.look_at(
        torch.tensor(eye), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]), width=width, height=height, fov_x=0.9
    )


def cloud(n=400, degree=3, seed=0):
    """Scattered Gaussians around the origin."""
    g = torch.Generator().manual_seed(seed)
    return GaussianModel(
        torch.randn(n, 3, generator=g) * 0.6, torch.randn(n, 1, 3, generator=g),
        0.2 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=g), 2 * torch.randn(n, generator=g),
        0.5 * torch.randn(n, 3, generator=g) - 2.5, torch.randn(n, 4, generator=g),
    )  # fmt: skip


@pytest.fixture(scope="session")
def toy(rasterizer):
    """A scene whose photographs are renders of a cloud: three views to train, one to test."""
    truth = cloud(seed=7)
    eyes = ([0.0, 0.0, -4.0], [3.0, 0.5, -3.0], [-3.0, 1.0, -2.5], [0.5, 2.0, -3.5])
    views = [View(camera(eye), f"{i}.png") for i, eye in enumerate(eyes)]
    with torch.no_grad():
        for view in views:
            image = rasterizer.render(truth.gaussians(view.camera, rasterizer), view.camera, RasterOptions()).image
            pixels = (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
            view.load = lambda pixels=pixels: pixels
    scene = Scene("toy", views[:3], views[3:], None, Protocol("toy"))
    return SimpleNamespace(scene=scene, truth=truth.requires_grad_(False))


@pytest.fixture(scope="session")
def make():
    return SimpleNamespace(camera=camera, cloud=cloud)
