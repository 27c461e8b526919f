"""The torch side of the codecs on a GPU: what it computes there is what it computes on the CPU."""

import numpy as np
import pytest
import torch

from sw_codecs.entropy import further_rates, rates
from sw_codecs.entropy.categorical import Categorical, CategoricalContext
from sw_codecs.positions.ordering import spatial_order

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"),
]


def test_points_have_one_order():
    points = torch.randn(5000, 3, generator=torch.Generator().manual_seed(0))
    order = spatial_order(points.cuda())
    assert order.is_cuda
    assert torch.equal(order.cpu(), spatial_order(points))


def test_rates_and_their_gradients_agree():
    draw = torch.Generator().manual_seed(1)
    x, mean = (torch.randn(200, generator=draw, dtype=torch.float64) for _ in range(2))
    scale = torch.rand(200, generator=draw, dtype=torch.float64) + 0.3
    logits, means, scales = (torch.rand(3, generator=draw, dtype=torch.float64) + 0.1 for _ in range(3))

    def everything(device):
        moved = [v.detach().clone().to(device).requires_grad_() for v in (x, mean, scale, logits, means, scales)]
        a, m, s, *mixed = moved
        found = [
            rates.gaussian_bits(a, m, s, 0.5),
            further_rates.laplace_bits(a, m, s, 0.5),
            further_rates.mixture_bits(a, *mixed, 0.5),
        ]
        sum(f.sum() for f in found).backward()
        return [v.detach().cpu() for v in (*found, *(p.grad for p in moved))]

    for here, there in zip(everything("cpu"), everything("cuda"), strict=True):
        torch.testing.assert_close(there, here, rtol=1e-9, atol=1e-12)


def test_a_file_from_parameters_on_a_gpu_decodes_without_one():
    torch.manual_seed(2)
    few = np.abs(np.rint(np.random.default_rng(3).normal(0, 5, 3000)).astype(np.int64)) % 7
    trained = CategoricalContext(7, n=3000, logits=torch.randn(7, device="cuda"))
    assert Categorical().bits(torch.from_numpy(few).cuda(), trained).is_cuda
    assert np.array_equal(Categorical().decode(Categorical().encode(few, trained), CategoricalContext(7, n=3000)), few)
