"""Pytest fixtures for methods that start from a trained scene: a scene of a few Gaussians and pixels.

A conftest.py takes them by import: `from sw_kit.toy_scene import make, one_thread, plugins, rasterizer, toy`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import SimpleNamespace

import pytest
import torch

from splatwizard_core.api import Camera, GaussianModel, PluginManager, Protocol, RasterOptions, Scene, View
from splatwizard_core.tooling import NegotiatedRasterizer, load_plugins

WIDTH, HEIGHT = 48, 36


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Compute on one thread: for tensors of a few hundred numbers more only cost."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def plugins() -> PluginManager:
    """The installed plugins."""
    return load_plugins()


@pytest.fixture(scope="session")
def rasterizer(plugins: PluginManager) -> NegotiatedRasterizer:
    """The rasterizer that the CPU draws with."""
    return NegotiatedRasterizer(plugins, device="cpu")


def camera(eye: Sequence[float], width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """Return a camera at `eye` (world units) that looks at the origin; width and height in pixels."""
    return Camera.look_at(
        torch.tensor(eye), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]), width=width, height=height, fov_x=0.9
    )


def gaussians(
    means: Sequence[Sequence[float]], opacities: Sequence[float], scales: Sequence[float], degree: int = 0
) -> GaussianModel:
    """Return grey Gaussians: means [N,3], opacities [N] in 0..1, scales [N] (isotropic) or [N,3], world units."""
    n = len(means)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    logits = torch.tensor(opacities).logit()
    log_scales = torch.tensor(scales).log()
    log_scales = log_scales[:, None].repeat(1, 3) if log_scales.dim() == 1 else log_scales
    return GaussianModel(
        torch.tensor(means), torch.zeros(n, 1, 3), torch.zeros(n, (degree + 1) ** 2 - 1, 3), logits, log_scales, quats
    )


def cloud(n: int = 400, degree: int = 3, seed: int = 0) -> GaussianModel:
    """Return n Gaussians scattered around the origin."""
    g = torch.Generator().manual_seed(seed)
    return GaussianModel(
        torch.randn(n, 3, generator=g) * 0.6, torch.randn(n, 1, 3, generator=g),
        0.2 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=g), 2 * torch.randn(n, generator=g),
        0.5 * torch.randn(n, 3, generator=g) - 2.5, torch.randn(n, 4, generator=g),
    )  # fmt: skip


@pytest.fixture(scope="session")
def toy(rasterizer: NegotiatedRasterizer) -> SimpleNamespace:
    """`scene`, whose photographs are renders of a cloud: three views to train, one to test; and `truth`, that cloud."""
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


def options() -> RasterOptions:
    """Return the options of a picture on black."""
    return RasterOptions(background=torch.zeros(3))


@pytest.fixture(scope="session")
def make() -> SimpleNamespace:
    """`camera`, `gaussians`, `cloud` and `options` of this module."""
    return SimpleNamespace(camera=camera, gaussians=gaussians, cloud=cloud, options=options)
