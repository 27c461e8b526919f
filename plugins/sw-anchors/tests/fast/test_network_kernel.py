"""The CUDA kernel of the three networks of anchors against torch operations."""

from __future__ import annotations

import pytest
import torch
from sw_anchors.anchors import two_layers
from sw_anchors.fast import networks as fast_networks
from sw_anchors.fast.networks import fits_kernel, network_outputs, parameters_of
from sw_anchors.native import ANCHORS

ON_CUDA = ANCHORS.available(cuda=True)
pytestmark = [pytest.mark.cuda, pytest.mark.skipif(ON_CUDA is not None, reason=str(ON_CUDA))]


def drawn(count, features, hidden, offsets):
    g = torch.Generator().manual_seed(0)
    networks = tuple(two_layers(features + 4, hidden, outputs * offsets, g) for outputs in (1, 7, 3))
    with torch.no_grad():
        for parameter in (p for network in networks for p in network.parameters()):
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=g))
    room = count + count // 50 + 10
    center, positions, values = (torch.randn(s, generator=g) for s in ((3,), (room, 3), (room, features + 36)))
    kept = has_slopes(networks, center, positions, values[:, :features]).nonzero()[:count, 0]
    assert len(kept) == count
    tensors = [tensor.to("cuda") for tensor in (center, positions[kept], values[kept])]
    slopes = [torch.randn(count, outputs * offsets, generator=g).to("cuda") for outputs in (1, 7, 3)]
    return tuple(network.to("cuda") for network in networks), *tensors, slopes


def has_slopes(networks, center, positions, features):
    """Whether an anchor's hidden numbers are all further than 1e-5 from 0, at which a ReLU has no slope.

    Of 3 million in float32, rounded to 1e-7, one or two nearer ones have either sign by the order of their sums.
    """
    toward = (positions - center).double()
    distance = toward.norm(dim=1, keepdim=True)
    context = torch.cat([features.double(), toward / distance, distance], dim=1)
    hidden = [context @ first.weight.double().t() + first.bias.double() for first, *_ in networks]
    return (torch.cat(hidden, dim=1).abs() > 1e-5).all(dim=1)


@pytest.mark.parametrize(
    ("count", "features", "hidden", "offsets"),
    [(20_000, 50, 50, 10), (8449, 51, 51, 8), (64, 32, 32, 4), (65, 7, 6, 5), (1, 50, 50, 10), (0, 50, 50, 10)],
)
def test_outputs_and_gradients_are_those_of_torch(count, features, hidden, offsets, monkeypatch):
    networks, center, positions, values, slopes = drawn(count, features, hidden, offsets)
    found = []
    for kernel in (True, False):
        if not kernel:
            monkeypatch.setattr(fast_networks, "fits_kernel", lambda *_: False)
        whole = values.clone().requires_grad_()
        own = whole[:, :features]  # columns of a matrix, as in training
        assert fits_kernel(positions, own, parameters_of(networks)) or not kernel
        outputs = network_outputs(center, positions, own, networks)
        grads = torch.autograd.grad(outputs, [whole, *parameters_of(networks)], slopes)
        assert all(grad.data_ptr() % 16 == 0 for grad in grads if grad.numel())  # as the optimizer's kernel asks
        found.append([*(each.detach() for each in outputs), *grads])
    for one, other in zip(*found, strict=True):
        limit = 1e-4 * float(other.abs().max()) if other.numel() else 0.0
        torch.testing.assert_close(one, other, rtol=1e-4, atol=limit)


def test_gradients_are_the_same_each_time():
    networks, center, positions, values, slopes = drawn(20_000, 50, 50, 10)
    own, parameters = values[:, :50].requires_grad_(), parameters_of(networks)
    assert fits_kernel(positions, own, parameters)
    found = [
        torch.autograd.grad(network_outputs(center, positions, own, networks), [own, *parameters], slopes)
        for _ in range(2)
    ]
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_networks_that_do_not_fit_are_computed_by_torch():
    for features, hidden, offsets in ((52, 50, 10), (50, 52, 10), (50, 50, 12)):
        networks, center, positions, values, _ = drawn(5, features, hidden, offsets)
        own = values[:, :features]
        assert not fits_kernel(positions, own, parameters_of(networks))
        assert network_outputs(center, positions, own, networks)[1].shape == (5, 7 * offsets)
