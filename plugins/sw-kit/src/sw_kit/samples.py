"""Small things to hold others against: a scene, and Gaussians in it."""

from __future__ import annotations

import functools

import torch
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.api import GaussianModel, Scene, SceneOptions
from splatwizard_core.tooling import load_plugins, load_scene

TINY = "demo:tiny"
SOME = 200


@functools.cache
def tiny_scene() -> Scene:
    """Return the scene `demo:tiny`."""
    return load_scene(TINY, SceneOptions(), load_plugins())


def some_gaussians(seed: int = 0) -> GaussianModel:
    """Return 200 Gaussians on start points of `demo:tiny`, with all SH bands and every parameter off its start."""
    points = tiny_scene().points
    assert points is not None
    model = gaussians_from_points(points)
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randperm(model.num_rows, generator=generator)[:SOME]
    tensors = {name: getattr(model, name).detach()[rows] for name in model.RAW}
    moved = {name: x + 0.1 * torch.randn(x.shape, generator=generator) for name, x in tensors.items()}
    return GaussianModel.from_tensors(**moved)
