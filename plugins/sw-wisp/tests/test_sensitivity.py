"""Costs of removal and squared slopes against brute force on small scenes."""

import pytest
import torch

from splatwizard_core.api import Camera, GaussianModel, RasterOptions, View
from sw_rasterizers.standard import StandardRasterizer
from sw_wisp.sensitivity import removal_cost, squared_slopes


def _scene(n: int = 20, size: int = 32, views: int = 3) -> tuple[GaussianModel, list[View]]:
    draws = torch.Generator().manual_seed(3)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=draws)

    model = GaussianModel(
        rand(n, 3) * 2 - 1, rand(n, 1, 3) * 2 - 1, rand(n, 15, 3) * 0.2 - 0.1, rand(n) * 3 - 1, rand(n, 3) - 2.2,
        rand(n, 4) - 0.5,
    )  # fmt: skip
    found = []
    for k in range(views):
        viewmat = torch.eye(4)
        viewmat[:3, 3] = torch.tensor([0.1 * k, -0.1 * k, 4.0])
        camera = Camera(R=viewmat[:3, :3], tau=viewmat[:3, 3], fx=36, fy=36, cx=size / 2, cy=size / 2, width=size,
                        height=size)  # fmt: skip
        picture = (rand(size, size, 3) * 255).to(torch.uint8).numpy()
        found.append(View(camera, name=f"{k}", load=lambda picture=picture: picture))
    return model, found


def _error(model: GaussianModel, views: list[View], background: torch.Tensor, without: int | None = None) -> float:
    total = 0.0
    rasterizer = StandardRasterizer()
    for view in views:
        inputs = model.gaussians(view.camera, rasterizer)
        if without is not None:
            inputs.opacities = inputs.opacities.detach().clone()
            inputs.opacities[without] = 0
        image = rasterizer.render(inputs, view.camera, RasterOptions(background=background)).image
        total += (image - view.image(background, "cpu")).double().square().sum().item()
    return total


def test_cost_is_the_error_after_removal_minus_before() -> None:
    model, views = _scene()
    background = torch.tensor([0.1, 0.2, 0.3])
    with torch.no_grad():
        found = removal_cost(model, views, StandardRasterizer(), background)
        before = _error(model, views, background)
        after = [_error(model, views, background, without=i) for i in range(model.num_rows)]
    assert found.total_error == pytest.approx(before, rel=1e-5)
    for i, value in enumerate(after):
        # float32 sums of about 3,000 in each view
        assert found.squared_error[i].item() == pytest.approx(value - before, rel=2e-4, abs=2e-3)
    assert found.values == 3 * 32 * 32 * 3


def test_splat_that_no_view_shows_costs_nothing() -> None:
    model, views = _scene()
    with torch.no_grad():
        model.means[4] = torch.tensor([0.0, 0.0, 50.0]) * -1
    found = removal_cost(model, views, StandardRasterizer(), torch.zeros(3))
    assert found.squared_error[4] == 0


def test_squared_slopes_are_those_of_each_pixel() -> None:
    model, views = _scene(n=6, size=8, views=1)
    rasterizer, background = StandardRasterizer(), torch.zeros(3)
    image = rasterizer.render(
        model.gaussians(views[0].camera, rasterizer), views[0].camera, RasterOptions(background=background)
    ).image
    expected = torch.zeros_like(model.sh_dc)
    for value in image.flatten():
        (slope,) = torch.autograd.grad(value, model.sh_dc, retain_graph=True)
        expected += slope.square()
    draws = torch.Generator().manual_seed(0)
    found = squared_slopes(model, ["sh_dc"], views, rasterizer, background, draws, draws=400)["sh_dc"]
    seen = expected > expected.max() * 1e-4
    ratios = (found / expected)[seen]
    assert ratios.mean() == pytest.approx(1, abs=0.05)
    assert ratios.min() > 0.7
    assert ratios.max() < 1.3
