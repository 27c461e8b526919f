"""Refinement of baked Gaussians: a short training on renders of the model that they replace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from splatwizard_core.api import Camera, GaussianModel, RasterOptions, SplatModel, photometric_loss, track

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer

STEP_SIZES = {
    "sh_dc": 2.5e-3, "sh_rest": 2.5e-4, "opacity_logits": 0.02, "log_scales": 3e-3, "quats": 1e-3,
}  # fmt: skip
"""Adam learning rates, those of late 3DGS training. Positions do not depend on the camera and stay fixed."""


def refine(
    baked: GaussianModel,
    model: SplatModel,
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    options: RasterOptions,
    *,
    steps: int,
    generator: torch.Generator,
) -> None:
    """Train baked Gaussians in place; each step fits the model's render from one camera.

    cameras     on any device; drawn from at random by `generator`
    options     as both are drawn
    """
    if not cameras:
        return
    groups = [{"params": [getattr(baked, name)], "lr": rate} for name, rate in STEP_SIZES.items()]
    baked.requires_grad_(True)
    optimizer = torch.optim.Adam([group for group in groups if group["params"][0].numel()], eps=1e-15)
    shown: dict[int, Tensor] = {}  # of each camera, in 8 bits: the model is slower to draw than to remember
    options = replace(options, scores=(), depth=frozenset(), normals=False, alpha=False)
    with track("refine", total=steps, foretells=True) as bar:
        for _ in range(steps):
            i = int(torch.randint(len(cameras), (), generator=generator))
            camera = cameras[i].to(baked.device)
            if i not in shown:
                with torch.no_grad():
                    image = rasterizer.render(model.gaussians(camera, rasterizer), camera, options).image
                shown[i] = (image.clamp(0, 1) * 255).round().byte()
            found = rasterizer.render(baked.gaussians(camera, rasterizer), camera, options).image
            loss = photometric_loss(found, shown[i].to(found) / 255)
            optimizer.zero_grad()
            loss.total.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            bar.advance(loss=loss.total.detach())
    baked.requires_grad_(False)
