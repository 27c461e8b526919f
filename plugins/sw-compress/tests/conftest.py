"""A small scene: a ball of soft splats of many colours and sizes."""

import math
from collections.abc import Callable

import pytest
import torch

from splatwizard_core.api import GaussianModel, stream


def _ball(n: int = 400, *, degree: int = 2, seed: int = 0) -> GaussianModel:
    random = stream(seed, "ball")
    normal = torch.nn.functional.normalize(torch.randn(n, 3, generator=random), dim=1)
    k = (degree + 1) ** 2 - 1
    return GaussianModel.from_tensors(
        normal * (1 + 0.05 * torch.randn(n, 1, generator=random)),
        torch.randn(n, 1, 3, generator=random),
        0.15 * torch.randn(n, k, 3, generator=random),
        2 * torch.randn(n, generator=random),
        math.log(0.09) + 0.4 * torch.randn(n, 3, generator=random),
        torch.randn(n, 4, generator=random),
    ).eval().requires_grad_(False)  # fmt: skip


@pytest.fixture(scope="session")
def ball() -> Callable[..., GaussianModel]:
    """Make one of so many Gaussians: ball(400, degree=2, seed=0)."""
    return _ball
