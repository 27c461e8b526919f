"""Layers: subsets by worth, what prefixes know, the order of packets, and a training whose file can be cut."""

import copy
from dataclasses import replace

import pytest
import torch
from sw_kit import short_training
from sw_kit.checks.prefixes import check_prefixes
from sw_kit.short_training import file_of, psnr
from test_training_wisp import SHORT, configured

from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.tooling import Prefix
from splatwizard_core.training.pipeline import TrainingStopped
from sw_wisp.layers import Known, Layers, admissible, as_known, greedy_order, split
from sw_wisp.method import Wisp
from sw_wisp.model import WispModel
from sw_wisp.packets import Packet, check_order
from sw_wisp.prefixes import fitted_swell, packet_bits, squared_error
from sw_wisp.pyramid import prefix_slots
from sw_wisp.rate import Forecast
from sw_wisp.rounding import HARD

PROGRESSIVE = {**SHORT, "layers.progressive": True, "layers.views": 2, "layers.swell": 6, "context.fit": 60}


@pytest.fixture(scope="module")
def train(plugins, rasterizer, toy):
    def run(directory=None, stop_after=None, **values):
        method = configured(plugins, **{**PROGRESSIVE, **values})
        model, _ = short_training.train(
            method, toy.scene, rasterizer, model=lambda: None, trained={"3dgs": toy.truth}.__getitem__,
            checkpoint_every=40, directory=directory, stop_after=stop_after,
        )  # fmt: skip
        return method, model

    return run


def on_one_thread(train, **values):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return train(**values)
    finally:
        torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def whole(train):
    return on_one_thread(train)


@pytest.fixture(scope="module")
def data(whole):
    return file_of(*whole)


@pytest.fixture(scope="module")
def plain(train):
    return on_one_thread(train, context__kind="none")


def prefix(plugins, data, packets):
    return Wisp(plugins, None).decode(ContainerReader(data, "file.swz", Prefix(packets)))


def test_the_header_tells_what_each_prefix_shows(data, plugins, toy, rasterizer):
    cuts = ContainerReader(data).cuts
    assert len(cuts) >= 8
    for packets in (1, len(cuts)):
        shown = psnr(prefix(plugins, data, packets), toy.scene, rasterizer)
        assert shown == pytest.approx(cuts[packets - 1].psnr, abs=0.01)
    assert "prefixes" in check_prefixes(data, lambda reader: Wisp(plugins, None).decode(reader))
    told = [cut.psnr for cut in cuts]
    assert told == sorted(told)
    assert told[0] < told[-1] - 1
    assert cuts[0].bytes < 0.8 * cuts[-1].bytes


def test_what_is_drawn_of_a_prefix_is_what_decoders_draw(plain, plugins, toy, rasterizer):
    method, model = plain
    data, model = file_of(method, model), copy.deepcopy(model).eval()
    order, camera = model.layers.order, toy.scene.test[0].camera
    for cut, packets in [(number, cut.sections - 1) for number, cut in enumerate(ContainerReader(data).cuts, 1)]:
        with torch.no_grad():
            ours = model.prefix_of(order[:packets], *model.predicted())
            theirs = prefix(plugins, data, cut).gaussians(camera, rasterizer)
            images = [rasterizer.render(each, camera, RasterOptions()).image for each in (ours, theirs)]
        assert torch.allclose(*images, atol=2e-3), cut


def test_packets_are_weighed_by_latents_that_decoders_predict(whole, data, plugins, toy, rasterizer):
    model = copy.deepcopy(whole[1]).eval()
    camera, errors = toy.scene.test[0].camera, []
    with torch.no_grad():
        forecast, drawn = model.predicted()
        theirs = prefix(plugins, data, 1).gaussians(camera, rasterizer)
        first = model.layers.order[:1]
        for each in (forecast, model.forecast_with(first, forecast, drawn)):
            shown = (model.prefix_of(first, each, drawn), theirs)
            ours, image = (rasterizer.render(found, camera, RasterOptions()).image for found in shown)
            errors.append(float((ours - image).square().mean()))
    assert errors[1] < errors[0] / 5  # the first knew latents that come later


def test_a_step_that_draws_packets_draws_what_decoders_do(plain):
    model = copy.deepcopy(plain[1]).train()
    model.phase, order = HARD, model.layers.order
    for packets in (1, len(order) - 1):
        model.packets = packets
        with torch.no_grad():
            shown, decoded = model.shown(model.draws()), model.prefix_of(order[:packets], *model.predicted())
        assert torch.allclose(shown.opacities, decoded.opacities)
        assert torch.allclose(shown.covariances, decoded.cov3d)
        assert torch.equal(shown.visible, decoded.visible)
    assert any(any(row) for row in model.layers.swell)


def test_a_step_that_draws_packets_predicts_latents_as_decoders_do(whole, data, plugins, toy, rasterizer):
    model, view = copy.deepcopy(whole[1]).train(), toy.scene.test[0]
    for number, cut in list(enumerate(ContainerReader(data).cuts, 1))[:-1]:
        model.packets = cut.sections - 1
        with torch.no_grad():
            ours, theirs = (
                rasterizer.render(each.gaussians(view.camera, rasterizer), view.camera, RasterOptions()).image
                for each in (model, prefix(plugins, data, number))
            )
            wrong = (theirs - view.image(toy.scene.background, theirs.device)).square().mean()
        # Coarse numbers, which networks are told finely in training, make the rest of it.
        assert (ours - theirs).square().mean() < wrong / 100, number


def test_prefixes_that_lack_latents_are_counted():
    order = ((0, "base"), (1, "base"), (0, "view"), (1, "fine"), (1, "view"))
    assert prefix_slots(order) == [[0, 0], [1, 0], [2, 1], [0, 2], [0, 3], [0, 0]]
    layers = Layers(order, 1)
    known = [Known.after(order[:packets], layers, torch.device("cpu")).slot.tolist() for packets in range(6)]
    assert known == prefix_slots(order)


def test_subsets_that_are_formed_early_stay_while_splats_go(plugins):
    early = {**PROGRESSIVE, "phases.subsets": 4_001, "phases.prefixes": 4_001}
    found = short_training.firings(configured(plugins, **early).stages()[0])
    assert found["form subsets"] == [20]
    assert found["draw some packets alone"][0] == found["swell subsets"][0] == 20
    assert max(found["remove by rate and distortion"]) > 20
    assert "subsets" in WispModel.ROWS


def test_what_swells_prefixes_lowers_their_loss(plain, toy, rasterizer):
    model = copy.deepcopy(plain[1]).eval()
    draws = torch.Generator().manual_seed(0)
    found = fitted_swell(model, toy.scene.train, rasterizer, toy.scene.background, 24, draws)
    assert [len(row) for row in found] == [2, 4, 6]
    errors = []
    for swell in ((), found):
        model.layers = replace(model.layers, swell=swell)
        with torch.no_grad():
            prefix = model.prefix_of(model.layers.order[:1], *model.predicted())
        errors.append(squared_error(prefix, toy.scene.train, rasterizer, toy.scene.background))
    assert errors[1] < errors[0]


def test_a_resumed_training_has_the_same_layers(train, plain, tmp_path):
    with pytest.raises(TrainingStopped):
        train(directory=tmp_path, stop_after=83, context__kind="none")
    _, resumed = train(directory=tmp_path, context__kind="none")
    assert resumed.layers == plain[1].layers
    assert resumed.digest() == plain[1].digest()


def test_flat_trainings_have_no_layers(plugins):
    names = short_training.firings(configured(plugins).stages()[0])
    assert not {"form subsets", "swell subsets", "draw some packets alone", "order packets"} & set(names)
    found = short_training.firings(configured(plugins, **PROGRESSIVE).stages()[0])
    assert found["draw some packets alone"][0] == 60
    assert found["order packets"] == [60, 80]


def test_subsets_get_their_shares_of_the_bits_worth_most_first():
    draws = torch.Generator().manual_seed(0)
    worth, bits = torch.rand(5_000, generator=draws) - 0.1, 20 + 40 * torch.rand(5_000, generator=draws)
    found = split(lambda there: worth, bits, bits, [0.1, 0.3, 0.6])
    shares = torch.stack([bits[found == subset].sum() for subset in range(3)]) / bits.sum()
    assert torch.allclose(shares, torch.tensor([0.1, 0.3, 0.6]), atol=0.002)
    ratios = (worth / bits).clamp_min(0)
    assert ratios[found == 0].min() >= ratios[found == 1].max()


def test_of_splats_that_cover_each_other_one_is_in_the_first_subset():
    n = 1_000
    twin, bits = torch.arange(n) ^ 1, torch.full((n,), 50.0)
    alone = 90 + 10 * torch.rand(n, generator=torch.Generator().manual_seed(0))

    def costs(there):  # of a pair little while both are there, of every fifth one alone nothing
        return alone * torch.where(there[twin], 0.01, 1.0) * torch.where(torch.arange(n) // 2 % 5 == 0, 1e-3, 1.0)

    first = split(costs, bits, bits, [0.4, 0.6]) == 0
    pairs = first.view(-1, 2).sum(1)
    lasting = torch.arange(n // 2) % 5 != 0
    assert first.sum() == 400
    assert (pairs[lasting] == 1).float().mean() > 0.75  # by costs that are measured once: half
    assert (pairs[~lasting] == 0).all()


def test_what_is_known_without_refinements_is_within_their_cells():
    draws = torch.Generator().manual_seed(0)
    mean, steps = torch.randn(50, 22, generator=draws), 0.1 + torch.rand(50, 22, generator=draws)
    k = torch.randint(-9, 10, (50, 22), generator=draws)
    values = (mean + k * steps).requires_grad_()
    layers = Layers.of_subsets(1, 2)
    known = [
        Known.after(layers.order[:packets], layers, mean.device).of(torch.zeros(50, dtype=torch.int64))
        for packets in range(1, 5)
    ]
    forecast = Forecast(mean, torch.full_like(mean, 30.0), steps)
    found = [as_known(values, forecast, each) for each in known]
    for cell, drawn in zip((9, 3, 1), found, strict=False):
        index = (drawn - mean) / steps
        assert torch.allclose(index[:, 1:10], torch.round(k[:, 1:10] / cell) * cell, atol=1e-3)
        assert torch.equal(drawn[:, 10:], mean[:, 10:])
        assert torch.equal(drawn[:, :1], values[:, :1])
    assert torch.allclose(found[3], values)
    found[0].sum().backward()
    assert (values.grad[:, :10] == 1).all()
    assert (values.grad[:, 10:] == 0).all()
    bits = packet_bits(values.detach(), forecast, torch.full((50,), 14.0), 2)
    flat = packet_bits(values.detach(), forecast, torch.full((50,), 14.0), 0)
    assert (bits["base"] < flat["base"]).all()
    assert torch.allclose(bits["base"] + bits["fine"], flat["base"], rtol=1e-5)
    assert torch.equal(bits["view"], flat["view"])


def test_the_greedy_order_takes_what_is_worth_most_for_its_bits():
    layers, worth = Layers.of_subsets(3, 1), {"base": 100.0, "fine": 30.0, "view": 8.0}

    def error(packets):
        return 1000 - sum(worth[kind] / (1 + 9 * subset * (kind == "base")) for subset, kind in packets)

    order = greedy_order(layers, error, lambda packet: 10.0)
    letters = [f"{subset + 1}{kind[0]}" for subset, kind in order]
    assert " ".join(letters) == "1b 1f 2b 2f 1v 2v 3b 3f 3v"
    check_order([Packet(subset, kind, 5) for subset, kind in order], 1)
    assert admissible([], layers) == [(0, "base")]
    assert len(admissible([(0, "base")], layers)) == 3
