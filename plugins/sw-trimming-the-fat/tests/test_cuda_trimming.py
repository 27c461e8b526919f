"""The score on a GPU is that on the CPU."""

import pytest
import torch

from sw_trimming_the_fat.score import worth

pytestmark = pytest.mark.cuda


def test_ranks_agree_with_ties():
    g = torch.Generator().manual_seed(0)
    opacities, gradients = torch.rand(10_000, generator=g), torch.randint(0, 300, (10_000,), generator=g).float()
    assert torch.equal(worth(opacities.cuda(), gradients.cuda()).cpu(), worth(opacities, gradients))
