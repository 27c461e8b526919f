"""The CUDA kernel of the three networks of anchors against torch operations."""

from __future__ import annotations

import pytest
import torch
from sw_anchors import view_networks
from sw_anchors.anchors import two_layers
from sw_anchors.native import ANCHORS
from sw_anchors.view_networks import fit_kernel, network_outputs, parameters_of

ON_CUDA = ANCHORS.available(cuda=True)
pytestmark = [pytest.mark.cuda, pytest.mark.skipif(ON_CUDA is not None, reason=str(ON_CUDA))]


def drawn(count, features, hidden, offsets):
    g = torch.Generator().manual_seed(0)
    networks = tuple(two_layers(features + 4, hidden, outputs * offsets, g).to("cuda") for outputs in (1, 7, 3))
    with torch.no_grad():
        for parameter in (p for network in networks for p in network.parameters()):
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=g).to("cuda"))
    tensors = [torch.randn(shape, generator=g).to("cuda") for shape in ((3,), (count, 3), (count, features + 36))]
    slopes = [torch.randn(count, outputs * offsets, generator=g).to("cuda") for outputs in (1, 7, 3)]
    return networks, *tensors, slopes


@pytest.mark.parametrize(
    ("count", "features", "hidden", "offsets"),
    [(20_000, 50, 50, 10), (8449, 51, 51, 8), (64, 32, 32, 4), (65, 7, 6, 5), (1, 50, 50, 10), (0, 50, 50, 10)],
)
def test_outputs_and_gradients_are_those_of_torch(count, features, hidden, offsets, monkeypatch):
    networks, center, positions, values, slopes = drawn(count, features, hidden, offsets)
    found = []
    for kernel in (True, False):
        if not kernel:
            monkeypatch.setattr(view_networks, "fit_kernel", lambda *_: False)
        whole = values.clone().requires_grad_()
        own = whole[:, :features]  # columns of a matrix, as in training
        assert fit_kernel(positions, own, parameters_of(networks)) or not kernel
        outputs = network_outputs(center, positions, own, networks)
        grads = torch.autograd.grad(outputs, [whole, *parameters_of(networks)], slopes)
        assert all(grad.data_ptr() % 16 == 0 for grad in grads if grad.numel())  # as the optimizer's kernel asks
        found.append([*(each.detach() for each in outputs), *grads])
    for one, other in zip(*found, strict=True):
        limit = 1e-4 * float(other.abs().max()) if other.numel() else 0.0
        torch.testing.assert_close(one, other, rtol=1e-4, atol=limit)


def test_networks_that_do_not_fit_are_computed_by_torch():
    for features, hidden, offsets in ((52, 50, 10), (50, 52, 10), (50, 50, 12)):
        networks, center, positions, values, _ = drawn(5, features, hidden, offsets)
        own = values[:, :features]
        assert not fit_kernel(positions, own, parameters_of(networks))
        assert network_outputs(center, positions, own, networks)[1].shape == (5, 7 * offsets)
