"""A toy scene, and few Gaussians whose scores can be worked out by hand."""

from types import SimpleNamespace

import pytest
import torch
from sw_gaussians.start import logit

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import Protocol, Scene, View

WIDTH, HEIGHT = 48, 36


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


def camera(eye, width=WIDTH, height=HEIGHT):
    return Camera.look_at(
        torch.tensor(eye), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]), width=width, height=height, fov_x=0.9
    )


def gaussians(means, opacities, scales, degree=0):
    """Isotropic grey ones."""
    n = len(means)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    logits = torch.tensor([logit(o) for o in opacities])
    log_scales = torch.tensor(scales).log()
    log_scales = log_scales[:, None].repeat(1, 3) if log_scales.dim() == 1 else log_scales
    return GaussianModel(
        torch.tensor(means), torch.zeros(n, 1, 3), torch.zeros(n, (degree + 1) ** 2 - 1, 3), logits, log_scales, quats
    )


def cloud(n=400, degree=3, seed=0):
    """Scattered ones around the origin."""
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
            drawn = rasterizer.render(truth.gaussians(view.camera, rasterizer), view.camera, options())
            pixels = (drawn.image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
            view.load = lambda pixels=pixels: pixels
    scene = Scene("toy", views[:3], views[3:], None, Protocol("toy"))
    return SimpleNamespace(scene=scene, truth=truth.requires_grad_(False))


def options():
    from splatwizard_core.rendering.rasterizer import RasterOptions

    return RasterOptions(background=torch.zeros(3))


@pytest.fixture(scope="session")
def make():
    return SimpleNamespace(camera=camera, gaussians=gaussians, cloud=cloud, options=options)
