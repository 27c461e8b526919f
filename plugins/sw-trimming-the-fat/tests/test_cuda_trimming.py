"""The score on a GPU is that on the CPU."""

import pytest
import torch

from sw_trimming_the_fat.score import doomed, worth

pytestmark = pytest.mark.cuda


def test_ranks_agree_with_ties():
    g = torch.Generator().manual_seed(0)
    opacities, gradients = torch.rand(10_000, generator=g), torch.randint(0, 300, (10_000,), generator=g).float()
    here = worth(opacities, gradients)
    there = worth(opacities.cuda(), gradients.cuda())
    assert torch.equal(there.cpu(), here)
    for rank in range(0, 10_000, 7):  # levels that are the quotients themselves: where the last bit decides
        assert torch.equal(doomed(there, rank / 9_999).cpu(), doomed(here, rank / 9_999))
