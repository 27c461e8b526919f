"""Steps of all anchors and outputs of a sample: one node against torch operations in float64."""

import pytest
import torch

from sw_codecs.context.two_layers import two_layers
from sw_hac import rate_model
from sw_hac.config import SMALLEST_STEP
from sw_hac.fast import steps_and_outputs as fast


def found_by(form, network, features, sample, slopes, dtype, device):
    network, leaf = network.to(device, dtype), features.detach().to(device, dtype).requires_grad_()
    base = torch.tensor([1.0, 0.004, 0.2], dtype=dtype, device=device)
    found = form(leaf, network, base, sample, 9)
    total = sum((each * slope.to(each)).sum() for each, slope in zip(found, slopes, strict=True))
    return [*(each.detach() for each in found), *torch.autograd.grad(total, [leaf, *network.parameters()])]


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [500, 7, 0])
@pytest.mark.parametrize("kind", ["the last", "some", "none"])
def test_the_node_equals_the_operators(count, kind, dtype, device):
    """On the CPU float32 has a kernel, float64 none."""
    g = torch.Generator().manual_seed(0)
    network = two_layers(20, 18, 14, g)
    with torch.no_grad():
        network[2].bias[9:12] = torch.tensor([-2.4, 0.0, 0.3])  # steps about the smallest, and above
        network[2].weight.mul_(2)
    features = torch.randn(count, 20, generator=g)
    samples = {"the last": slice(count // 2, None), "none": torch.arange(0),
               "some": torch.nonzero(torch.rand(count, generator=g) < 0.3).squeeze(1)}  # fmt: skip
    sample = samples[kind] if kind == "the last" else samples[kind].to(device)
    size = len(torch.arange(count)[samples[kind]])
    slopes = [torch.randn(size, generator=g) for size in ((count, 3), (size, 3), (size, 14))]
    found = found_by(fast.steps_and_outputs, network, features, sample, slopes, dtype, device)
    expected = found_by(rate_model.steps_and_outputs, network, features, sample, slopes, torch.float64, device)
    if count == 500:
        at_floor = (expected[0][:, 0] == SMALLEST_STEP).double().mean()
        assert 0.05 < at_floor < 0.95
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a.double(), b, atol=5e-5, rtol=5e-5)  # float32 sums over 500 rows


def test_places_that_nobody_was_drawn_for_name_one_row_again_and_again():
    """As a captured step has it: their gradients are zeros."""
    g = torch.Generator().manual_seed(0)
    network, features = two_layers(5, 6, 14, g), torch.randn(9, 5, generator=g)
    sample = torch.tensor([1, 4, 8, 8, 8])
    slopes = [torch.randn(9, 3, generator=g), torch.randn(5, 3, generator=g), torch.randn(5, 14, generator=g)]
    for slope in slopes[1:]:
        slope[2:] = 0
    found = found_by(fast.steps_and_outputs, network, features, sample, slopes, torch.float64, "cpu")
    expected = found_by(rate_model.steps_and_outputs, network, features, sample, slopes, torch.float64, "cpu")
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b)
