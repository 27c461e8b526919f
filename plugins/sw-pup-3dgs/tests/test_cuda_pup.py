"""The score on a GPU is that on the CPU."""

import pytest
import torch

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.scene.camera import Camera
from sw_pup_3dgs.score import FisherScore, log_determinants

pytestmark = pytest.mark.cuda


def test_log_determinants_agree():
    g = torch.Generator().manual_seed(0)
    factors = torch.randn(500, 9, 6, generator=g, dtype=torch.float64)
    row, column = torch.triu_indices(6, 6)
    blocks = (factors.mT @ factors)[:, row, column]
    blocks[::7] = 0
    torch.testing.assert_close(log_determinants(blocks.cuda()).cpu(), log_determinants(blocks))


def test_scores_agree():
    g = torch.Generator().manual_seed(1)
    n = 400
    raw = [
        0.4 * torch.randn(n, 3, generator=g), torch.randn(n, 1, 3, generator=g),
        0.1 * torch.randn(n, 8, 3, generator=g), torch.randn(n, generator=g),
        0.3 * torch.randn(n, 3, generator=g) - 2.5, torch.randn(n, 4, generator=g),
    ]  # fmt: skip
    eyes = torch.tensor([[3.0, 0, 1], [-3.0, 0, 1], [0, 3.0, 1], [0, -3.0, 1.5]])
    up = torch.tensor([0.0, 0, 1])
    cameras = [Camera.look_at(eye, torch.zeros(3), up, width=130, height=90, fov_x=0.8) for eye in eyes]
    found = {}
    for device in ("cpu", "cuda"):
        model = GaussianModel(*(tensor.to(device) for tensor in raw))
        rasterizer = NegotiatedRasterizer(load_plugins(), device=device)
        found[device] = FisherScore(2).score(model, cameras, rasterizer).cpu()
    drawn = found["cpu"].isfinite()
    assert int(drawn.sum()) > n // 2
    assert torch.equal(drawn, found["cuda"].isfinite())
    # Float32 sums in another order: small eigenvalues differ by more than rounding.
    assert float((found["cpu"] - found["cuda"])[drawn].abs().median()) < 1e-2
    order = [torch.argsort(found[device]) for device in ("cpu", "cuda")]
    low = [set(o[: n // 2].tolist()) for o in order]
    assert len(low[0] & low[1]) > 0.98 * n // 2
