"""The start from a trained scene: what few splats at the end of the world, and very thin ones, do to all others."""

import torch
from sw_reference.rasterizer import ReferenceRasterizer

from splatwizard_core.api import Camera, GaussianModel, RasterOptions, View
from sw_wisp.config import WispConfig
from sw_wisp.conversion import FAR_SHARE, converted, within_reach


def scene(n=40):
    draws = torch.Generator().manual_seed(0)
    means = torch.rand(n, 3, generator=draws) - 0.5 + torch.tensor([0, 0, 3.0])
    means[-1] = torch.tensor([2_000.0, 0, -3_000])  # where no camera looks
    logs = torch.log(torch.rand(n, 3, generator=draws) * 0.2 + 0.05)
    logs[0] = torch.tensor([-2.0, -2.0, -19.0])
    return GaussianModel.from_tensors(
        means, torch.rand(n, 1, 3, generator=draws), torch.zeros(n, 15, 3), torch.full((n,), 1.0), logs,
        torch.nn.functional.normalize(torch.randn(n, 4, generator=draws), dim=1),
    )  # fmt: skip


def camera():
    return Camera(width=32, height=24, fx=30.0, fy=30.0, cx=16.0, cy=12.0, R=torch.eye(3), tau=torch.zeros(3))


def test_what_nobody_sees_far_away_goes_and_all_others_look_as_they_did():
    model, rasterizer = scene(), ReferenceRasterizer()
    truth = rasterizer.render(model.gaussians(camera(), rasterizer), camera(), RasterOptions()).image.detach()
    pixels = (truth.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    views = [View(camera(), "a", lambda: pixels)]
    found = converted(model, views, rasterizer, torch.zeros(3), WispConfig(), torch.Generator().manual_seed(0))
    assert len(found.means) == 39
    assert found.cube.edge < 2
    tidied = found.tidied()
    for name in ("shape", "size"):  # the ranges that are kept hold them
        torch.testing.assert_close(tidied[name], getattr(found, name).detach())


def test_what_is_worth_something_stays_however_far():
    means = torch.zeros(100, 3)
    means[:, 0] = torch.linspace(-1, 1, 100)
    means[7, 1] = 500.0
    costs = torch.ones(100)
    assert bool(within_reach(means, costs).all())
    costs[7] = 100 * FAR_SHARE * 0.9
    assert within_reach(means, costs).nonzero().flatten().tolist() == [i for i in range(100) if i != 7]
    assert bool(within_reach(means, torch.zeros(100)).any())
