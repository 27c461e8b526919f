"""channel-mixture: published sizes, causal slices, and integers that follow the floats."""

import pytest
import torch
from torch import nn

from sw_hac_plus.channel_mixture import LEAK, ChannelMixture

SLICES = (2, 3, 4)


def made(context=5, hidden=6, **values):
    return ChannelMixture(SLICES, context=context, hidden=hidden, generator=torch.Generator().manual_seed(0), **values)


def count(module):
    return sum(p.numel() for p in module.parameters())


def test_counts_are_the_published_ones():
    full = ChannelMixture([10] * 5, context=150)
    assert [network[0].in_features for network in full.networks.values()] == [150, 160, 170, 180, 190]
    assert [count(network) for network in full.networks.values()] == [7270, 7670, 8070, 8470, 8870]
    assert count(full) == 40_350
    tiny = ChannelMixture([10] * 5, context=0, hidden=None)
    assert [count(network) for network in tiny.networks.values()] == [1260, 1560, 1860, 2160]
    assert count(tiny) == 6870
    for model in (full, tiny, made(), made(0)):
        assert ChannelMixture.count(model.slices, context=model.context, hidden=model.hidden) == count(model)


@pytest.mark.parametrize("context", [5, 0])
def test_a_slice_depends_on_earlier_ones_of_its_row_alone(context):
    model = made(context)
    values, seen = torch.randn(6, 9), torch.randn(6, 5)
    before = torch.stack(model(values, seen))
    for column in range(9):
        changed = values.clone()
        changed[2, column] += 1
        touched = (torch.stack(model(changed, seen)) != before).any(dim=0)
        own = next(i for i in range(3) if model.part(i).start <= column < model.part(i).stop)
        assert not touched[[0, 1, 3, 4, 5]].any()
        assert not touched[2, : model.part(own).stop].any()
        assert touched[2, model.part(own).stop :].all()


def test_the_second_scale_starts_where_it_is_told_to():
    with torch.no_grad():
        _, scale, _ = made(0, None, scale=1.5)(torch.zeros(4, 9), torch.zeros(4, 0))
    assert torch.equal(scale[:, :2], torch.full((4, 2), 1.5))
    full = made(scale=1.5)
    for network, size in zip(full.networks.values(), SLICES, strict=True):
        assert torch.equal(network[2].bias[size : 2 * size].detach(), torch.full((size,), 1.5))


@pytest.mark.parametrize("context", [5, 0])
def test_integers_follow_the_floats(context):
    g = torch.Generator().manual_seed(1)
    model = made(context, 6 if context else None)
    known = torch.round(torch.randn(10_000 // 9, 9, generator=g) * 4096)
    seen = torch.round(torch.randn(len(known), context, generator=g) * 4096)
    exact = model.exact()
    negative = 0
    for i in range(3):
        start = model.starts[i]
        with torch.no_grad():
            floats = model.slice(i, known[:, :start] / 4096, seen / 4096).detach()
            if start + context:
                inputs = torch.cat([known[:, :start], seen], dim=1) / 4096
                negative += int((model.networks[f"slice{i}"][0](inputs) < 0).sum())
        found = exact.slice(i, known[:, :start].long(), seen.long())
        assert found.dtype == torch.int64
        assert float((found / 4096 - floats).abs().max()) < 2**-9
        assert torch.equal(exact.slice(i, known[:7, :start].long(), seen[:7].long()), found[:7])
    assert negative > 1000


def test_the_slope_is_that_of_the_integers():
    network = made().networks["slice0"]
    assert isinstance(network[1], nn.LeakyReLU)
    assert network[1].negative_slope == LEAK / 4096


def test_weights_that_no_exact_network_takes_are_refused():
    model = made(0)
    with torch.no_grad():
        model.first[0, 0] = torch.inf
    with pytest.raises(ValueError, match="not finite"):
        model.exact()
    model = made()
    with torch.no_grad():
        model.networks["slice1"][0].weight[0, 0] = 5000
    with pytest.raises(ValueError, match="4096"):
        model.exact()
    with pytest.raises(ValueError, match="positive sizes"):
        ChannelMixture([2, 0], context=1)
