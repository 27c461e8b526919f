"""Checks of a rasterizer's result against the contract: types, shapes and gradients, without waiting for a GPU."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from splatwizard_core.gaussians.inputs import GaussianInputs
from splatwizard_core.rendering.rasterizer import RasterOptions, RenderResult
from splatwizard_core.scene.camera import Camera


def faults(result: object, g: GaussianInputs, cam: Camera, opt: RasterOptions, *, learns: bool) -> Iterator[str]:
    """Say in a line each what is not as `render` promises; `learns`: gradients were on when it was called."""
    if torch.is_grad_enabled() != learns:
        torch.set_grad_enabled(learns)
        yield f"it switches gradients {'off' if learns else 'on'}"
    if not isinstance(result, RenderResult):
        yield f"it returns {type(result).__name__} for RenderResult"
        return
    size, maps = (cam.height, cam.width), {f"depth '{mode}'": result.depth.get(mode) for mode in opt.depth}
    sizes = {"image": (3 if g.colors is None else g.colors.shape[1], *size), "radii": (len(g),)}
    for name, found in {"image": result.image, "radii": result.radii, **maps}.items():
        shape = tuple(found.shape) if isinstance(found, Tensor) else type(found).__name__
        if shape != sizes.get(name, (1, *size)):
            yield f"{name} is {shape}, must be {sizes.get(name, (1, *size))}"
            return
    trained = learns and any(each.requires_grad for each in g.tensors().values())
    if trained and not result.image.requires_grad and bool(result.visible.any()):
        yield "its picture has no gradient"
