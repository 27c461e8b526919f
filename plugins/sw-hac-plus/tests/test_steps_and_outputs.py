"""Steps of all anchors and outputs of the last of them: one node against torch operations in float64."""

import pytest
import torch

from sw_hac_plus.fast.steps_and_outputs import steps_and_outputs


def by_torch(features, parameters, base, *, part, start, offset, smallest):
    first, first_bias, last, last_bias = parameters
    hidden = torch.relu(features @ first.t() + first_bias)
    outputs = hidden @ last.t() + last_bias
    return (offset + torch.tanh(outputs[:, part])).clamp(min=smallest) * base, outputs[start:]


def found_by(form, tensors, dtype, device, slopes, **kwargs):
    leaves = [t.detach().to(device, dtype).requires_grad_() for t in tensors]
    base = torch.tensor([1.0, 0.004, 0.2], dtype=dtype, device=device)
    steps, outputs = form(leaves[0], tuple(leaves[1:]), base, part=slice(9, 12), **kwargs)
    total = sum((each * slope.to(each)).sum() for each, slope in zip((steps, outputs), slopes, strict=True))
    return [steps.detach(), outputs.detach(), *torch.autograd.grad(total, leaves)]


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("count", "start"), [(500, 430), (7, 0), (7, 7), (0, 0)])
def test_the_node_equals_the_operators(count, start, dtype, device):
    """On the CPU float32 has a kernel, float64 none."""
    g = torch.Generator().manual_seed(0)
    sizes = ((count, 20), (18, 20), (18,), (14, 18), (14,))
    tensors = [torch.randn(size, generator=g) / (4 if len(size) == 2 else 1) for size in sizes]
    slopes = torch.randn(count, 3, generator=g), torch.randn(count - start, 14, generator=g)
    kwargs = {"start": start, "offset": 1.0, "smallest": 0.4}
    found = found_by(steps_and_outputs, tensors, dtype, device, slopes, **kwargs)
    expected = found_by(by_torch, tensors, torch.float64, device, slopes, **kwargs)
    if count == 500:
        base = torch.tensor([1.0, 0.004, 0.2], dtype=torch.float64, device=device)
        at_floor = (expected[0] == base * 0.4).double().mean()
        assert 0.05 < at_floor < 0.95
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a.double(), b, atol=5e-5, rtol=5e-5)  # float32 sums over 500 rows
