"""One fact about rasterizers as a function that can be called, and the steps that such functions share."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass

import torch
from torch import Tensor

from splatwizard_core.api import Camera, GaussianInputs, Rasterizer, RasterOptions, RenderResult
from sw_reference.testing.raster_scenes import with_tensors

CheckFunction = Callable[[Rasterizer, str], None]

SLACK = {"approx-fp16": 1.5 / 255, "approx-uint8": 1.5 / 255}
"""Declared exactness -> difference of a value of 0..1 that is no fault: a step of an 8-bit picture and its rounding."""
_slack: ContextVar[float] = ContextVar("slack", default=0.0)


@dataclass(frozen=True)
class Check:
    """One fact; call it with the rasterizer and the device to run on. Raises AssertionError.

    Values of a rasterizer that is declared as approximate may differ by `SLACK`.
    """

    function: CheckFunction
    needs: frozenset[str]

    def __call__(self, rasterizer: Rasterizer, device: str = "cpu") -> None:
        before = _slack.set(SLACK.get(rasterizer.info.exactness, 0.0))
        try:
            self.function(rasterizer, device)
        finally:
            _slack.reset(before)

    def __str__(self) -> str:
        return self.function.__name__


CHECKS: list[Check] = []
"""Every fact, in the order in which the modules that state them are imported."""


def check(*needs: str) -> Callable[[CheckFunction], CheckFunction]:
    """Add a function to the list; `needs` are names of features."""

    def add(function: CheckFunction) -> CheckFunction:
        CHECKS.append(Check(function, frozenset(needs)))
        return function

    return add


def draw(rasterizer: Rasterizer, device: str, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
    """Render on `device`; results come back as they are."""
    moved = with_tensors(g, {name: x.to(device) for name, x in g.tensors().items()})
    return rasterizer.render(moved, cam.to(device), opt)


def close(actual: Tensor, expected: Tensor | float, *, atol: float = 1e-5, rtol: float = 1e-5) -> None:
    """Values agree; devices and dtypes do not matter."""
    atol = max(atol, _slack.get())
    wanted = torch.as_tensor(expected, dtype=torch.float64).detach().cpu()
    torch.testing.assert_close(actual.detach().double().cpu(), wanted.expand(actual.shape), atol=atol, rtol=rtol)
