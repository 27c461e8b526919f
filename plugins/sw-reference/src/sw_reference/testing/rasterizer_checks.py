"""Facts that hold for every rasterizer of 3DGS or 2DGS: closed forms, invariances, culling, broken inputs, scores.

A package tests its rasterizer with

    @pytest.mark.parametrize("check", checks_for(MyRasterizer.info), ids=str)
    def test_check(check):
        check(MyRasterizer(), "cpu")

and, for values and gradients on random scenes, `sw_reference.testing.raster_gradients`. A check is left out if it
needs a feature that the rasterizer does not declare. They run in float32.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from splatwizard_core.api import Camera, GaussianInputs, Rasterizer, RasterizerInfo, RasterOptions, RenderResult
from sw_reference.testing.raster_scenes import with_tensors

CheckFunction = Callable[[Rasterizer, str], None]


@dataclass(frozen=True)
class Check:
    """One fact; call it with the rasterizer and the device to run on. Raises AssertionError."""

    function: CheckFunction
    needs: frozenset[str]

    def __call__(self, rasterizer: Rasterizer, device: str = "cpu") -> None:
        self.function(rasterizer, device)

    def __str__(self) -> str:
        return self.function.__name__


_CHECKS: list[Check] = []


def check(*needs: str) -> Callable[[CheckFunction], CheckFunction]:
    """Add a function to the list; `needs` are names of features."""

    def add(function: CheckFunction) -> CheckFunction:
        _CHECKS.append(Check(function, frozenset(needs)))
        return function

    return add


def checks_for(info: RasterizerInfo) -> list[Check]:
    """Every check whose needs `info` declares, and that asks for what `info` cannot do without."""
    for module in ("raster_closed_forms", "raster_robustness", "raster_scores", "raster_surfels"):  # each adds its own
        importlib.import_module(f"sw_reference.testing.{module}")
    return [c for c in _CHECKS if info.needs <= c.needs <= info.features]


def front_camera(width: int = 64, height: int = 64, **changes: float) -> Camera:
    """At the origin, looking along +z, focal length 64 px, principal point in the centre."""
    cam = Camera(width, height, 64.0, 64.0, width / 2, height / 2, torch.eye(3), torch.zeros(3))
    return replace(cam, **changes)  # type: ignore[arg-type]


def splats(
    means: list[list[float]], *, opacities: list[float], scales: list[float] | None = None, colors: Tensor | None = None
) -> GaussianInputs:
    """Isotropic Gaussians, default scale 0.2, default colours distinct and fixed; float32 on the CPU."""
    n = len(means)
    if colors is None:
        colors = 0.2 + 0.6 * torch.rand(n, 3, generator=torch.Generator().manual_seed(5))
    size = torch.tensor(scales if scales is not None else [0.2] * n, dtype=torch.float32)
    return GaussianInputs(
        torch.tensor(means, dtype=torch.float32).reshape(n, 3),
        torch.tensor(opacities, dtype=torch.float32),
        size[:, None].repeat(1, 3),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        colors=colors,
    )


def draw(rasterizer: Rasterizer, device: str, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
    """Render on `device`; results come back as they are."""
    moved = with_tensors(g, {name: x.to(device) for name, x in g.tensors().items()})
    return rasterizer.render(moved, cam.to(device), opt)


def close(actual: Tensor, expected: Tensor | float, *, atol: float = 1e-5, rtol: float = 1e-5) -> None:
    """Values agree; devices and dtypes do not matter."""
    wanted = torch.as_tensor(expected, dtype=torch.float64).detach().cpu()
    torch.testing.assert_close(actual.detach().double().cpu(), wanted.expand(actual.shape), atol=atol, rtol=rtol)
