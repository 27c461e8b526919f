"""Anchors with a lattice, masks and phases: what HAC and CAT-3DGS share."""

import copy
import math
from contextlib import nullcontext

import pytest
import torch
from sw_anchors.coded_anchors import ENTROPY, FULL, QUANTIZED, CodedAnchors
from sw_anchors.decoded_anchors import DecodedAnchors
from sw_anchors.growth import adjust_anchors
from sw_anchors.lattice import TOP, bounds_of, coded_positions, position_codes
from sw_anchors.rate_model import AnchorDistributions, AnchorForecast, Floors, gaussian_rate
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import front_camera

from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer

RASTERIZER = ReferenceRasterizer()


class FlatRate:
    """One distribution for all anchors; deviations of the features are those of the anchors, if there are any."""

    def __init__(self, log_steps, shape, floors, deviations=None):
        self.log_steps, self.shape, self.floors, self.deviations = log_steps, shape, floors, deviations

    def forecast(self, context, sample):
        (rows,) = context
        steps = self.log_steps.exp().expand(len(rows), 3)
        scales = torch.ones(len(rows), sum(self.shape.widths))
        if self.deviations is not None:
            scales = torch.cat([self.deviations[rows], scales[:, self.shape.features :]], dim=1)
        return AnchorForecast(steps, steps[sample], scales[sample])

    def rate(self, values, forecast, masks, counted):
        scale = forecast.outputs
        return gaussian_rate(
            values, torch.zeros_like(values), scale, forecast.sample_steps, masks, counted, self.floors
        )


class Flat(CodedAnchors):
    """CodedAnchors with a FlatRate."""

    deviations = None

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.log_steps = torch.nn.Parameter(torch.tensor([0.0, math.log(0.01), math.log(0.2)]))

    def context_rows(self):
        return (torch.arange(self.num_rows),)

    @property
    def rate_model(self):
        return FlatRate(self.log_steps, self.shape, self.floors, self.deviations)


class FlatOfAll(Flat):
    """The same with a rate of a sample of all anchors."""

    RATE_OF = "all"


def make(n=8, k=4, feature_dim=5, seed=0, kind=Flat, **kwargs):
    g = torch.Generator().manual_seed(seed)
    return kind(
        torch.rand(n, 3, generator=g) * 2 - torch.tensor([1.0, 1.0, -3.0]),
        torch.randn(n, feature_dim, generator=g),
        torch.randn(n, k, 3, generator=g),
        torch.randn(n, 6, generator=g) * 0.3 - 2,
        voxel_size=0.1, hidden=8, generator=g, **kwargs,
    )  # fmt: skip


def test_positions_lie_on_the_lattice_below_the_anchors():
    x = torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 30.0, 0.01])
    bounds = bounds_of(x)
    step = (bounds[1].double() - bounds[0].double()) / TOP
    codes = position_codes(x, bounds)
    assert codes.amin(0).tolist() == [0, 0, 0]
    assert codes.amax(0).tolist() == [TOP] * 3
    below = x.double() - (codes * step + bounds[0].double())
    assert float(below.min()) >= 0
    assert bool((below < step * (1 + 1e-9)).all())
    torch.testing.assert_close(coded_positions(codes, bounds), x, atol=float(step.max()), rtol=0)


def test_bounds_have_the_published_margin_or_a_tenth_of_the_extent():
    x = torch.tensor([[-1.0, 2.0, 0.0], [4.0, 3.0, -5.0]])
    torch.testing.assert_close(bounds_of(x, "origin"), torch.tensor([[-1.2, 1.6, -6.0], [4.8, 3.6, 0.0]]))
    torch.testing.assert_close(bounds_of(x, "extent"), torch.tensor([[-1.5, 1.9, -5.5], [4.5, 3.1, 0.5]]))
    torch.testing.assert_close(bounds_of(x, "none"), torch.tensor([[-1.0, 2.0, -5.0], [4.0, 3.0, 0.0]]))


def test_anchors_in_one_plane_and_outside_the_bounds_have_codes():
    x = torch.tensor([[0.5, 0.0, 0.0], [0.5, 1.0, 2.0]])
    bounds = bounds_of(x)
    codes = position_codes(torch.cat([x, torch.tensor([[9.0, -3.0, 1.0]])]), bounds)
    assert codes[:2, 0].tolist() == [0, 0]
    assert codes[2].tolist() == [TOP, 0, TOP // 2]


def test_positions_follow_anchors_and_bounds():
    model = make()
    first = model.positions()
    assert model.positions() is first
    with torch.no_grad():
        model.anchors[0] += 0.01
    assert model.positions() is not first
    second = model.positions()
    model.update_bounds("extent")
    assert not torch.equal(model.positions(), second)


def test_each_phase_moves_values_by_its_own_step():
    model, rows = make(n=400), torch.arange(400)
    raw = model.raw(rows)
    for phase, steps in ((FULL, (0, 0, 0)), (QUANTIZED, (1.0, 0.001, 0.2)), (ENTROPY, (1.0, 0.01, 0.2))):
        model.phase = phase
        for training in (True, False):
            model.train(training)
            a = model.attributes(rows)
            found = (a.features, a.scales, a.offsets.flatten(1))
            for x, y, step in zip(raw, found, steps, strict=True):
                moved = (y - x).detach().abs().max()
                assert float(moved) <= step / 2 + 1e-6
                assert float(moved) >= 0.45 * step
                if not training and step:
                    torch.testing.assert_close(torch.round(y / step) * step, y)
            assert ("rate" in a.extras) == (phase == ENTROPY and training)


def test_noise_of_the_second_phase_has_steps_of_its_own(monkeypatch):
    model, rows = make(n=400), torch.arange(400)
    steps = model.noise_steps(model.features)
    monkeypatch.setattr(model, "noise_steps", lambda like: 1.1 * steps)
    model.phase = QUANTIZED
    moved = (model.attributes(rows).features - model.features).detach().abs().max()
    assert 0.5 < float(moved) <= 0.55


def test_a_larger_step_is_learned_through_the_noise_and_the_bin():
    model = make(n=50)
    model.phase, model.sample = ENTROPY, 1.0
    a = model.attributes(torch.arange(50))
    a.features.square().sum().backward(retain_graph=True)
    assert float(model.log_steps.grad[0]) != 0
    model.zero_grad()
    a.extras["rate"].bits.backward()
    assert bool((model.log_steps.grad < 0).all())  # wider bins cost fewer bits


def test_the_rate_of_a_whole_sample_is_that_of_all_kept_anchors():
    model = make(n=60)
    with torch.no_grad():
        model.mask_logits[:20] = -6  # these anchors go
        model.mask_logits[20:30, 1] = -6
    model.phase, model.sample = ENTROPY, 1.0
    rows = torch.arange(60)
    rate = model.attributes(rows).extras["rate"]
    assert rate.numbers == 40 * (5 + 6 + 12)
    masks, values = model.masks(rows), tuple(v.detach() for v in model.raw(rows))
    kept = masks.detach().amax(dim=1)
    forecast = model.rate_model.forecast(model.context_of(rows), rows)
    bits_of_all, by_group = model.rate_model.rate(torch.cat(values, dim=1), forecast, masks, kept)
    normal = torch.distributions.Normal(0.0, 1.0)
    probability = normal.cdf(values[2] + 0.1) - normal.cdf(values[2] - 0.1)
    bits = -torch.log2(probability.clamp(min=1e-6)) * masks.repeat_interleave(3, 1)
    torch.testing.assert_close(by_group[2], bits[20:].sum().detach(), rtol=1e-4, atol=0.01)
    torch.testing.assert_close(bits_of_all.detach(), by_group.sum())
    torch.testing.assert_close(rate.bits.detach(), rate.by_group.sum() / rate.numbers * 40 / 60)


@pytest.mark.parametrize("floor", [0.0, 0.05])
def test_deviations_below_zero_learn_if_there_is_a_floor(floor):
    """Of features half a step beside the mean; at the published floor of 1e-9 the bits say nothing of the deviation."""
    model = make(n=20, scale_floor=floor)
    raw = model.deviations = torch.full((20, 5), -0.5, requires_grad=True)
    rows = torch.arange(20)
    forecast = model.rate_model.forecast(model.context_of(rows), rows)
    values = torch.cat([torch.full((20, 5), 0.55), *(v.detach() for v in model.raw(rows)[1:])], dim=1)
    bits, by_group = model.rate_model.rate(values, forecast, model.masks(rows), torch.ones(20))
    bits.backward()
    if floor:
        assert bool((raw.grad < 0).all())  # descent raises them
    else:
        assert bool((raw.grad == 0).all())
    assert by_group[0] > 100 * (1.6 if floor else 19.9)


@pytest.mark.parametrize("floor", [0.0, 0.05])
def test_means_far_from_all_numbers_learn_if_there_is_a_floor(floor):
    """Of a column whose mean is 263 steps away: without REACH every density there is 0 in float32."""
    mean = torch.full((20, 23), -263.0, requires_grad=True)
    scale = torch.full((20, 23), 0.4, requires_grad=True)
    ones = torch.ones(20)
    bits, _ = gaussian_rate(
        torch.zeros(20, 23), mean, scale, torch.ones(20, 3), torch.ones(20, 4), ones, Floors(scale=floor)
    )
    bits.backward()
    for grad in (mean.grad, scale.grad):
        assert bool((grad < -1e-3).all() if floor else (grad.abs() < 1e-30).all())  # descent raises both
    torch.testing.assert_close(bits.detach(), 20 * 23 * -torch.log2(torch.tensor(1e-6)))


@pytest.mark.parametrize("kind", [Flat, FlatOfAll])
def test_an_empty_sample_costs_nothing(kind):
    model = make(kind=kind)
    model.phase, model.sample = ENTROPY, 0.0
    rate = model.attributes(torch.arange(8)).extras["rate"]
    assert (float(rate.bits.detach()), rate.numbers) == (0.0, 0)
    assert float(model.attributes(torch.arange(0)).extras["rate"].bits.detach()) == 0.0


def test_the_rate_may_be_that_of_a_sample_of_all_anchors():
    """Under noise of its own: what a view sees has no part in it."""
    model = make(n=60, kind=FlatOfAll)
    model.phase, model.sample = ENTROPY, 1.0
    rate = model.attributes(torch.arange(3)).extras["rate"]
    assert rate.numbers == 60 * (5 + 6 + 12)
    rate.bits.backward()
    assert bool((model.features.grad != 0).any(dim=1).all())


class Older(Flat):
    """Flat as it was written for 0.2."""

    rate_model, context_rows = CodedAnchors.rate_model, CodedAnchors.context_rows

    def predict(self, rows):
        widths, n = self.shape.widths, len(rows)
        steps = self.log_steps.exp()
        return AnchorDistributions(
            tuple(torch.zeros(n, w) for w in widths),
            tuple(torch.ones(n, w) for w in widths),
            tuple(step.expand(n, 1) for step in steps),
        )


def test_a_subclass_that_predicts_as_in_0_2_has_the_same_rate_and_is_told():
    rates = []
    for kind in (Flat, Older):
        model = make(n=60, kind=kind)
        model.phase, model.sample, model.noise = ENTROPY, 0.5, torch.Generator().manual_seed(0)
        with pytest.warns(DeprecationWarning, match="give a rate_model") if kind is Older else nullcontext():
            rates.append(model.attributes(torch.arange(60)).extras["rate"].bits)
    torch.testing.assert_close(*rates)
    with pytest.raises(NotImplementedError, match="has no rate_model"):
        CodedAnchors.rate_model.fget(make())


def test_masks_remove_gaussians_and_learn_from_picture_and_rate():
    model, cam = make(n=30), front_camera()
    with torch.no_grad():
        model.mask_logits[:, 2] = -5  # sigmoid 0.0067
        model.mask_logits[3] = -5
    assert model.kept().tolist() == [i != 3 for i in range(30)]
    assert model.counts() == {"num_anchors": 29, "num_gaussians": 87}
    model.phase, model.sample = ENTROPY, 1.0
    inputs = model.gaussians(cam, RASTERIZER)
    selection = inputs.extras["anchors"]
    assert bool((selection.drawn % 4 != 2).all())
    RASTERIZER.render(inputs, cam, RasterOptions()).image.square().sum().backward()
    assert float(model.mask_logits.grad.abs().max()) > 0
    model.zero_grad()
    model.attributes(torch.arange(30)).extras["rate"].bits.backward()
    assert float(model.mask_logits.grad[model.kept(), :2].min()) > 0  # fewer offsets, fewer bits


def test_negative_scales_draw_as_positive_ones():
    model, cam = make(), front_camera()
    a = model.attributes(torch.arange(8))
    scales = a.scales.detach().clone()
    scales[:, 3:] *= -1
    masks = torch.ones(8, 4, dtype=torch.bool)
    decoded = DecodedAnchors(a.positions, a.features.detach(), a.offsets.detach(), scales, masks, hidden=8)
    for name in model.NETWORKS:
        getattr(decoded, name).load_state_dict(getattr(model, name).state_dict())
    options = RasterOptions()
    with torch.no_grad():
        ours = RASTERIZER.render(model.gaussians(cam, RASTERIZER), cam, options).image
        theirs = RASTERIZER.render(decoded.gaussians(cam, RASTERIZER), cam, options).image
    assert torch.equal(ours, theirs)
    assert decoded.counts() == {"num_anchors": 8, "num_gaussians": 32}


def test_growth_extends_masks_and_their_moments():
    model = make()
    groups = [ParamGroup(name, 0.01) for name in ("features", "offsets", "log_scales", "mask_logits")]
    optimizer = SplatOptimizer(model, groups)
    model.mask_logits.square().sum().backward()
    optimizer.step()
    model.offset_denom.fill_(50)
    model.offset_grad_accum.fill_(50.0)
    report = adjust_anchors(model, optimizer, step=100, generator=torch.Generator().manual_seed(0))
    assert report.grown > 0
    assert bool((model.mask_logits[8:] == 1).all())
    assert model.codes().shape == (report.total, 3)
    assert not bool(optimizer.moments("mask_logits")[0][8:].any())


def test_phase_and_bounds_are_part_of_the_state():
    model, other = make(), make(seed=3)
    model.phase = ENTROPY
    model.update_bounds("extent")
    other.load_resized(model.state_dict())
    other.load_state_dict_extra(model.state_dict_extra())
    assert other.digest() == model.digest()
    assert other.phase == ENTROPY
    assert torch.equal(other.positions(), model.positions())
    assert copy.deepcopy(model).digest() == model.digest()


def test_far_values_are_clamped_about_the_mean_of_the_kept():
    model = make(n=4)
    with torch.no_grad():
        model.features[0, 0] = 1e6
    model.phase = QUANTIZED
    model.eval()
    with torch.no_grad():
        found = model.attributes(torch.arange(4)).features[0, 0]
    mean = float(model.features.detach().double().mean())
    assert float(found) == pytest.approx(round(mean) + 15_000)


def test_base_steps_stay_where_they_are():
    """A CUDA graph reads them by address, whatever is computed in another dtype meanwhile."""
    model, like = make(), torch.zeros(1)
    first = model.base_steps_like(like)
    assert model.base_steps_like(like.double()).dtype == torch.float64
    assert model.base_steps_like(like) is first
    model.base_steps = (2.0, 0.001, 0.2)
    assert model.base_steps_like(like).tolist() == pytest.approx([2.0, 0.001, 0.2])
