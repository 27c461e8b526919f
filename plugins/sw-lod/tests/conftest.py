"""A scene of a few hundred Gaussians, for all tests."""

import math

import pytest
import torch

from splatwizard_core.api import GaussianModel


def cloud(count: int, seed: int = 0) -> GaussianModel:
    rng = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng)

    return GaussianModel.from_tensors(
        draw(count, 3), draw(count, 1, 3), 0.1 * draw(count, 3, 3), draw(count),
        math.log(0.1) + 0.3 * draw(count, 3), torch.nn.functional.normalize(draw(count, 4), dim=1),
    )  # fmt: skip


@pytest.fixture(scope="session")
def model() -> GaussianModel:
    return cloud(1200)
