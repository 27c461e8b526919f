"""The reference can be trained with: gradients are good enough to fit a picture."""

import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import front_camera

from splatwizard_core.api import GaussianInputs, RasterOptions


@pytest.mark.pipeline
def test_sixty_gaussians_fit_a_picture():
    generator = torch.Generator().manual_seed(0)
    n, cam = 60, front_camera(24, 24, fx=32.0, fy=32.0)
    ys, xs = torch.meshgrid(torch.linspace(0, 3, 24), torch.linspace(0, 3, 24), indexing="ij")
    target = 0.5 + 0.5 * torch.stack([torch.sin(2 * xs), torch.cos(3 * ys), torch.sin(xs * ys)])
    position = (torch.rand(n, 3, generator=generator) - 0.5) * 3
    means = position + torch.tensor([0.0, 0, 4])
    raw = {
        "means": means,
        "log_scales": torch.full((n, 3), -2.0),
        "quats": torch.randn(n, 4, generator=generator),
        "logits": torch.zeros(n),
        "colors": torch.rand(n, 3, generator=generator),
    }
    for x in raw.values():
        x.requires_grad_()
    optimizer = torch.optim.Adam(list(raw.values()), lr=0.04)
    rasterizer, losses = ReferenceRasterizer(), []
    for _ in range(50):
        g = GaussianInputs(
            raw["means"], raw["logits"].sigmoid(), raw["log_scales"].exp(), raw["quats"], colors=raw["colors"]
        )
        loss = (rasterizer.render(g, cam, RasterOptions()).image - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0] / 10
