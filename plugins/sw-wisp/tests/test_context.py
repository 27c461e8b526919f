from dataclasses import replace

import numpy as np
import pytest
import torch
from wisp_scenes import made_up

from splatwizard_core.api import BitstreamError, ContainerReader, ContainerWriter
from sw_codecs.bits.packing import ByteReader
from sw_wisp import file
from sw_wisp.context import ContextNetworks
from sw_wisp.cube import Cube
from sw_wisp.eight_bits import EXACT_EXPONENT, EightBitLayer, rounded_weights
from sw_wisp.fitting import fitted_context
from sw_wisp.nested import UNIT, Counter, index_bits, table_levels
from sw_wisp.numbers import BASE_STEPS, COLOUR, GROUPS, NUMBERS
from sw_wisp.packets import Packet, Walk
from sw_wisp.predicting import PyramidContext
from sw_wisp.pyramid import walked_features
from sw_wisp.rate import bits, sigma_of
from sw_wisp.rounding import NOISE, Rounding

STEPS = torch.tensor(BASE_STEPS)


def some_networks(seed: int = 0, **changes) -> ContextNetworks:
    """Networks that say something, on features of all sizes."""
    draws = torch.Generator().manual_seed(seed)
    net = ContextNetworks(generator=draws, **changes)
    net.prior.copy_(torch.arange(NUMBERS) * 160)
    with torch.no_grad():
        for network, width in zip(net.networks, (1, 6, 3, 12), strict=True):
            last = network[-1]
            last.weight.copy_(torch.randn(last.weight.shape, generator=draws) * 0.3)
            last.bias[width : 2 * width] = 30.0
        for tie in net.ties:
            tie.copy_(torch.randn(tie.shape, generator=draws) * 0.2)
    return net


def written(scene) -> tuple[bytes, file.Encoded]:
    writer = ContainerWriter("wisp", 1)
    return (encoded := file.encode(scene, writer)) and writer.to_bytes(), encoded


def bits_of(state) -> np.ndarray:
    return index_bits(table_levels(state.scale.astype(np.int64)), state.index)


def test_counts_of_the_networks():
    counts = [sum(p.numel() for p in network.parameters()) for network in ContextNetworks().networks]
    assert counts == [2_339, 4_094, 2_695, 4_225]
    assert sum(p.numel() for p in ContextNetworks(size="small").networks.parameters()) == 6_701
    assert sum(tie.numel() for tie in ContextNetworks().ties) == 18 + 6 + 96


@pytest.mark.parametrize(("subsets", "planes", "size"), [(1, 0, "large"), (3, 1, "small"), (2, 2, "large")])
def test_files_return(subsets, planes, size):
    scene = replace(made_up(1200, subsets=subsets, planes=planes), context=some_networks(size=size).exact())
    data, encoded = written(scene)
    decoded = file.decode(ContainerReader(data))
    assert decoded.digest() == encoded.decoded.digest()
    assert len(np.unique(decoded.state.multiplier)) > 20
    away = np.abs(decoded.values().numpy() - np.clip(scene.values.numpy()[encoded.rows], -8, 8))
    fits = np.abs(scene.values.numpy()[encoded.rows]) < 3
    assert (away[fits] <= (0.5001 * np.array(BASE_STEPS) * decoded.state.multiplier / UNIT)[fits]).all()


@pytest.mark.parametrize(("subsets", "planes"), [(1, 0), (3, 1)])
def test_training_has_the_features_of_the_file(subsets, planes):
    """What the walk through a file predicts is what the float networks say of the features of a training."""
    net = some_networks()
    scene = made_up(1500, subsets=subsets, planes=planes)
    _, encoded = written(replace(scene, context=net.exact()))
    state, rows = encoded.decoded.state, torch.from_numpy(encoded.rows)
    values = torch.empty(1500, NUMBERS, dtype=torch.float64)
    values[rows] = torch.from_numpy(state.units(np.arange(1500), slice(None)) / UNIT)
    indices, multipliers = torch.empty_like(values), torch.empty_like(values)
    indices[rows] = torch.from_numpy(state.index).double()
    multipliers[rows] = torch.from_numpy(state.multiplier / UNIT)
    labels = None if scene.subsets is None else torch.from_numpy(scene.subsets)
    features = walked_features(
        net.prior, scene.levels, scene.cells, values, indices, labels=labels, planes=planes, multipliers=multipliers
    )
    net.rounds = True
    with torch.no_grad():
        forecast, _ = net(*features, (values * STEPS).float())
    mean = (forecast.mean / STEPS)[rows].double()
    # The order of crowded cells may differ, and inputs of B to D stand coarse in the file's walk if there are planes.
    close = (mean - torch.from_numpy(state.mean / UNIT)).abs() < 0.02
    exact = slice(0, 1) if planes else slice(None)
    assert float(close[:, exact].double().mean()) > 0.99
    scale = forecast.scale[rows].double().clamp(0, 63)
    assert float((scale - torch.from_numpy(state.scale / UNIT)).abs()[:, exact].median()) < 0.02


def test_steps_are_those_of_the_table_with_a_gradient():
    net = ContextNetworks()
    t = torch.tensor([[0.0], [-0.01], [2.0], [-9.0], [9.0]], requires_grad=True)
    found = net._multipliers(t)
    assert (found[:, 0] * UNIT).tolist() == [4352, 3840, *(found[2:, 0] * UNIT).tolist()]
    assert (found[3:, 0] * UNIT).tolist() == [64, 8192]
    found.sum().backward()
    assert float(t.grad[0]) == 1
    assert 0 < float(t.grad[2]) < 0.1


def test_start_from_statistics_says_the_running_mean_and_the_deviation_from_it():
    scene = made_up(4000)
    net = ContextNetworks(adaptive=False)
    values = (scene.values / STEPS).float()
    net.measure_prior(values)
    features = walked_features(net.prior, scene.levels, scene.cells, values, values.round())
    net.start(*features, values)
    forecast, _ = net(*features, scene.values.float())
    assert torch.allclose(forecast.mean[:, :10], features[0][:, :10] * STEPS[:10])
    sigma = sigma_of(forecast.scale, forecast.steps)[0]
    residual = (scene.values - forecast.mean).square().mean(0).sqrt()
    assert torch.allclose(sigma[:10].double(), residual[:10], rtol=1e-3)


def test_weights_of_eight_bits_are_those_of_the_file():
    weight = torch.randn(7, 9, generator=torch.Generator().manual_seed(3), requires_grad=True)
    found = rounded_weights(weight, EXACT_EXPONENT)
    layer = EightBitLayer.nearest(weight.detach().numpy(), np.zeros(7), lowest=EXACT_EXPONENT)
    assert np.array_equal(found.detach().numpy(), layer.floats()[0])
    found.sum().backward()
    assert (weight.grad == 1).all()


def test_gradients_reach_every_network_and_the_values():
    scene = made_up(300)
    net = some_networks()
    values = scene.values.float().clone().requires_grad_()
    features = walked_features(
        net.prior, scene.levels, scene.cells, scene.values / STEPS, (scene.values / STEPS).round()
    )
    forecast, drawn = net(*features, values, Rounding(NOISE))
    bits(drawn - forecast.mean, sigma_of(forecast.scale, forecast.steps), forecast.steps).sum().backward()
    assert all(float(p.grad.abs().sum()) > 0 for p in net.parameters())
    assert (values.grad != 0).any(dim=0).all()


def test_the_context_returns_and_damage_is_refused():
    context = some_networks(adaptive=False).exact()
    reader = ByteReader(context.pack())
    again = PyramidContext.unpack(reader)
    reader.finish()
    assert np.array_equal(again.prior, context.prior)
    assert not again.adaptive
    pairs = [*zip(again.layers, context.layers, strict=True), *zip(again.ties, context.ties, strict=True)]
    assert all(np.array_equal(a.weights, b.weights) for a, b in pairs)
    data = bytearray(context.pack())
    for damaged in (data[:100], bytes([7]) + data[1:]):
        with pytest.raises(BitstreamError):
            PyramidContext.unpack(ByteReader(damaged))


def test_a_later_wave_changes_nothing_before_it():
    """Causality: other values of splats of the last wave leave the predictions of all before them alone."""
    scene = replace(made_up(640), context=some_networks().exact())
    _, first = written(scene)
    late = first.rows[1::2]
    values = scene.values.clone()
    values[late, 1:10] += 1.0
    _, second = written(replace(scene, values=values))
    assert np.array_equal(first.rows, second.rows)
    early = np.arange(640) % 2 == 0
    a, b = first.decoded.state, second.decoded.state
    assert np.array_equal(a.mean[early, :10], b.mean[early, :10])
    assert np.array_equal(a.scale[early, :10], b.scale[early, :10])
    assert not np.array_equal(a.index[~early], b.index[~early])


def test_estimates_are_the_size_of_the_file():
    """Of integer tables within 0.5 %, of the floats of a training within 2 %."""
    scene = made_up(10_000)
    net = ContextNetworks(adaptive=False)
    values = (scene.values / STEPS).float()
    net.measure_prior(values)
    features = walked_features(net.prior, scene.levels, scene.cells, values, values.round())
    net.start(*features, values)
    data, encoded = written(replace(scene, context=net.exact()))
    state, rows = encoded.decoded.state, torch.from_numpy(encoded.rows)
    spent = bits_of(state).sum(0)
    counter = Counter()
    walk = Walk(net.exact(), file.fit_shares([state.cells]), 0, [state.cells], lambda r, c, _: state.index[r, c])
    for kind in ("base", "view"):
        walk.packet(counter, Packet(0, kind, 10_000))
    sections = ContainerReader(data).sections
    assert counter.total == pytest.approx(8 * (sections["packet.01"] + sections["packet.02"]), rel=0.005)
    assert spent[10:].sum() == pytest.approx(8 * sections["packet.02"], rel=0.005)

    units = torch.empty(10_000, NUMBERS, dtype=torch.float64)
    units[rows] = torch.from_numpy(state.units(np.arange(10_000), slice(None)) / UNIT)
    index = torch.empty_like(units)
    index[rows] = torch.from_numpy(state.index).double()
    with torch.no_grad():
        features = walked_features(net.prior, scene.levels, scene.cells, units, index)
        forecast, drawn = net(*features, (units * STEPS).float())
        found = bits(drawn - forecast.mean, sigma_of(forecast.scale, forecast.steps), forecast.steps).double().sum(0)
    for group in GROUPS:
        assert float(found[group.columns].sum()) == pytest.approx(spent[group.columns].sum(), rel=0.02)


def plane(n: int, colour) -> file.Scene:
    """Splats of level 8 on a plane, one in a cell, colours by place."""
    side = int(n**0.5)
    x, y = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    cells = torch.stack([x.flatten(), y.flatten(), torch.full((side * side,), 100)], dim=1)
    levels = torch.full((len(cells),), 8)
    values = torch.zeros(len(cells), NUMBERS, dtype=torch.float64)
    values[:, COLOUR.columns] = colour(cells.double() / side)
    return file.Scene(Cube((0.0, 0.0, 0.0), 1.0), levels, cells, values, ())


def colour_bits(scene, updates=120) -> tuple[float, float]:
    """Bits of the colours with fitted networks, and the entropy of their columns."""
    net = fitted_context(scene.levels, scene.cells, scene.values, STEPS, updates=updates, batch=256)
    data, encoded = written(replace(scene, context=net.exact()))
    state = encoded.decoded.state
    spent = bits_of(state)[:, COLOUR.columns].sum()
    marginal = 0.0
    for column in range(COLOUR.columns.start, COLOUR.columns.stop):
        _, counts = np.unique(np.rint(scene.values[:, column].numpy() / BASE_STEPS[column]), return_counts=True)
        marginal += float(-(counts * np.log2(counts / counts.sum())).sum())
    assert spent < 8 * sum(ContainerReader(data).sections.values())
    return float(spent), marginal


def test_smooth_colour_costs_little():
    waves = torch.tensor([[1.5, 2.5, 0.0], [3.0, -2.0, 0.0], [1.0, 3.5, 0.0]]).double()
    spent, marginal = colour_bits(plane(3_600, lambda at: torch.sin(at @ waves.T)))
    assert spent < 0.45 * marginal


def test_chroma_that_follows_luma_costs_what_is_left():
    """Noise of chroma that luma tells 0.8 of, in deviations, costs log2(1 / 0.6) = 0.74 bits less than by itself."""
    draws = torch.Generator().manual_seed(1)
    luma, own = torch.randn(2, 3_600, 1, generator=draws, dtype=torch.float64)
    still = torch.zeros_like(luma)
    colours = torch.cat([0.3 * luma, 0.24 * luma + 0.18 * own, still], dim=1)
    spent, marginal = colour_bits(plane(3_600, lambda at: colours), 240)
    assert (marginal - spent) / 3_600 == pytest.approx(0.74, abs=0.08)  # 2 % of what the columns cost by themselves


def test_a_splat_far_from_its_first_latents_expects_others_far():
    """Latents of one strength a splat cost less than the entropy that they would have one by one."""
    draws = torch.Generator().manual_seed(2)
    strength = torch.exp(0.8 * torch.randn(3000, 1, generator=draws, dtype=torch.float64))
    scene = made_up(3000)
    values = scene.values.clone()
    values[:, 10:] = 0.3 * strength * torch.randn(3000, 12, generator=draws, dtype=torch.float64)
    scene = replace(scene, values=values.clamp(-2.9, 2.9))
    net = fitted_context(scene.levels, scene.cells, scene.values, STEPS, updates=150, batch=512)
    spent = bits_of(written(replace(scene, context=net.exact()))[1].decoded.state)[:, 10:].mean(0)
    assert spent[4:].mean() < spent[:4].mean() - 0.1


def test_white_noise_costs_what_it_must():
    draws = torch.Generator().manual_seed(0)
    noise = torch.randn(3_600, 3, generator=draws, dtype=torch.float64) * 0.3
    spent, marginal = colour_bits(plane(3_600, lambda at: noise))
    assert spent < 1.02 * marginal


@pytest.mark.parametrize(("flags", "reason"), [(4, "flags 4"), (3, None)])
def test_flags_of_other_networks_are_refused(flags, reason):
    """Not known, or of small networks before large ones."""
    data = bytes([flags]) + some_networks().exact().pack()[1:]
    with pytest.raises(BitstreamError, match=reason):
        PyramidContext.unpack(ByteReader(data))
