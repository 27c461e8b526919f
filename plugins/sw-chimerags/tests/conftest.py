"""Small students with all that an encoder asks of them."""

import pytest
import torch

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from sw_chimerags.model import MaskedGaussians


@pytest.fixture(scope="session")
def plugins():
    return load_plugins()


@pytest.fixture
def student(plugins):
    """(n, how many masks are on, seed) -> a distilled student of random Gaussians, importance 0 .. n - 1 by row."""

    def make(n: int = 120, on: int = 40, seed: int = 0) -> MaskedGaussians:
        g = torch.Generator().manual_seed(seed)
        model = GaussianModel(
            torch.randn(n, 3, generator=g), torch.randn(n, 1, 3, generator=g), 0.2 * torch.randn(n, 15, 3, generator=g),
            torch.randn(n, generator=g), torch.randn(n, 3, generator=g) - 3, torch.randn(n, 4, generator=g),
        )  # fmt: skip
        masked = MaskedGaussians.of(model, quantizer=plugins.quantizers.load("ste-mask")(0.01), init=-6.0)
        with torch.no_grad():
            masked.mask_logits[torch.randperm(n, generator=g)[:on]] = 1.0
        masked.set_importance(torch.arange(n).float())
        return masked

    return make
