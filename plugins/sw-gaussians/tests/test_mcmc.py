"""Relocation, growth and noise of MCMC density control, against sums written out and against their own laws."""

from decimal import Decimal, getcontext
from math import comb
from types import SimpleNamespace

import pytest
import torch
from sw_gaussians.density.mcmc import MCMC, add_noise, draw, grow, relocate, shared_among
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.errors import ShapeError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.scene.scene import PointCloud
from splatwizard_core.streams import stream
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer


def by_the_double_sum(opacity: float, scale: float, n: int) -> tuple[float, float]:
    """The published formula as it is printed, in 80 digits: its signs alternate."""
    getcontext().prec = 80
    o = Decimal(opacity)
    after = 1 - (1 - o) ** (1 / Decimal(n))
    total = sum(
        comb(i - 1, k) * (-1) ** k * after ** (k + 1) / Decimal(k + 1).sqrt() for i in range(1, n + 1) for k in range(i)
    )
    return float(after), float(Decimal(scale) * o / total)


@pytest.mark.parametrize("opacity", [0.006, 0.1, 0.5, 0.9, 0.99, 0.999999])
@pytest.mark.parametrize("copies", [1, 2, 3, 10, 51])
def test_the_correction_is_the_published_double_sum(opacity, copies):
    after, scales = shared_among(
        torch.tensor([opacity], dtype=torch.float64),
        torch.full((1, 3), 0.3, dtype=torch.float64),
        torch.tensor([copies]),
    )
    expected = by_the_double_sum(opacity, 0.3, copies)
    assert float(after) == pytest.approx(expected[0], rel=1e-11)
    assert scales[0].tolist() == pytest.approx([expected[1]] * 3, rel=1e-9)  # the terms reach 1e5 times their sum


def test_copies_let_as_much_light_through_as_the_one():
    opacities = torch.linspace(0.01, 0.99, 9)
    for n in (2, 7, 51):
        after, scales = shared_among(opacities, torch.ones(9, 3), torch.full((9,), n))
        torch.testing.assert_close(1 - (1 - after) ** n, opacities, rtol=1e-5, atol=1e-6)
        assert (scales < 1).all()


def test_one_copy_changes_nothing_and_more_than_51_count_as_51():
    opacities, scales = torch.rand(5), torch.rand(5, 3)
    same = shared_among(opacities, scales, torch.ones(5, dtype=torch.int64))
    torch.testing.assert_close(same, (opacities, scales))
    most = shared_among(opacities, scales, torch.full((5,), 51))
    more = shared_among(opacities, scales, torch.full((5,), 900))
    assert all(torch.equal(a, b) for a, b in zip(most, more, strict=True))


def test_extreme_opacities_stay_finite():
    after, scales = shared_among(torch.tensor([0.0, 1.0]), torch.ones(2, 3), torch.tensor([51, 51]))
    assert torch.isfinite(after).all()
    assert torch.isfinite(scales).all()


def test_rows_are_drawn_in_proportion_to_their_weights():
    weights = torch.tensor([0.0, 1.0, 0.0, 3.0, 0.0])
    counts = torch.bincount(draw(weights, 8000, stream(1, "x")), minlength=5)
    assert counts[[0, 2, 4]].tolist() == [0, 0, 0]
    assert counts[3] / 8000 == pytest.approx(0.75, abs=0.02)  # four deviations


def model_of(opacities: list[float]) -> tuple[GaussianModel, SplatOptimizer]:
    n = len(opacities)
    generator = torch.Generator().manual_seed(5)
    model = gaussians_from_points(
        PointCloud(torch.rand(n, 3, generator=generator), torch.rand(n, 3, generator=generator)), max_sh_degree=1
    )
    with torch.no_grad():
        model.opacity_logits.copy_(torch.logit(torch.tensor(opacities)))
        model.quats.normal_(generator=generator)
    optimizer = SplatOptimizer(model, [ParamGroup(k, lr=1e-3) for k, _ in model.named_parameters()])
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    optimizer.zero_grad()
    return model, optimizer


def test_the_dead_move_onto_a_live_one_and_share_with_it():
    model, optimizer = model_of([0.002, 0.8, 0.003])
    before = {k: v.detach().clone() for k, v in model.named_parameters()}
    opacity, scale = model.opacities[1].item(), model.scales[1, 0].item()
    assert relocate(model, optimizer, stream(0, "r")) == 2
    for name in ("means", "sh_dc", "sh_rest", "quats"):
        assert torch.equal(getattr(model, name), before[name][[1, 1, 1]])
    after, smaller = by_the_double_sum(opacity, scale, 3)
    assert model.opacities.tolist() == pytest.approx([after] * 3, rel=1e-5)
    assert model.scales[:, 0].tolist() == pytest.approx([smaller] * 3, rel=1e-5)
    for name, _ in model.named_parameters():
        exp_avg, exp_avg_sq, step = optimizer.moments(name)
        assert not exp_avg[1].any()  # the source
        assert not exp_avg_sq[1].any()
        assert exp_avg[[0, 2]].all()  # those that moved
        assert exp_avg_sq[[0, 2]].all()
        assert step == 1


def test_who_is_neither_dead_nor_chosen_keeps_everything():
    model, optimizer = model_of([0.9] + [0.001] + [0.5] * 30)
    before = {k: v.detach().clone() for k, v in model.named_parameters()}
    assert relocate(model, optimizer, stream(0, "r")) == 1
    changed = (model.opacity_logits != before["opacity_logits"]).nonzero().flatten().tolist()
    assert len(changed) == 2  # the dead one and its source
    assert 1 in changed
    kept = [i for i in range(32) if i not in changed]
    for name, _ in model.named_parameters():
        assert torch.equal(getattr(model, name)[kept], before[name][kept])
        exp_avg, exp_avg_sq, _ = optimizer.moments(name)
        assert exp_avg[kept].all()
        assert exp_avg_sq[kept].all()
        source = next(i for i in changed if i != 1)
        assert not exp_avg[source].any()
        assert exp_avg[1].all()


@pytest.mark.parametrize("opacities", [[0.3, 0.4], [0.001, 0.002]], ids=["none dead", "none alive"])
def test_nothing_moves_without_the_dead_or_without_the_living(opacities):
    model, optimizer = model_of(opacities)
    before = model.digest()
    assert relocate(model, optimizer, stream(0, "r")) == 0
    assert model.digest() == before


@pytest.mark.parametrize(
    ("count", "cap", "expected"), [(100, 1000, 105), (100, 103, 103), (100, 50, 100), (19, 99, 19)]
)
def test_growth_is_five_per_cent_up_to_the_cap(count, cap, expected):
    model, optimizer = model_of([0.5] * count)
    light = 1 - model.opacities
    assert grow(model, optimizer, stream(0, "g"), cap=cap) == expected - count
    assert model.num_rows == expected
    exp_avg, _, _ = optimizer.moments("means")
    assert exp_avg.shape == (expected, 3)
    assert exp_avg[:count].all()  # sources go on as they were
    assert not exp_avg[count:].any()
    assert not model.grad_accum.any()
    # What all of them let through together is what it was: copies share, they do not add.
    torch.testing.assert_close((1 - model.opacities).log().sum(), light.log().sum(), rtol=1e-5, atol=0)


def test_the_noise_has_the_covariance_of_the_gaussian_and_spares_the_opaque():
    model, _ = model_of([0.005] * 20_000)
    with torch.no_grad():
        model.opacity_logits[0] = 8.0
        model.means.zero_()
        model.log_scales.copy_(torch.tensor([0.5, 0.2, 1.0]).log().expand(20_000, 3))
        model.quats.copy_(torch.tensor([0.9, 0.1, -0.3, 0.2]).expand(20_000, 4))
    add_noise(model, stream(3, "n"), lr=1e-4, strength=5e5)
    w, x, y, z = torch.nn.functional.normalize(model.quats[0], dim=0).double().tolist()
    rotation = torch.tensor([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ], dtype=torch.float64)  # fmt: skip
    sigma = rotation @ torch.diag(torch.tensor([0.25, 0.04, 1.0], dtype=torch.float64)) @ rotation.T
    expected = sigma @ sigma * (1e-4 * 5e5 * 0.5) ** 2  # the logistic is 1/2 at the threshold
    moved = model.means[1:].detach().double()
    found = moved.T @ moved / len(moved)
    assert float((found - expected).norm() / expected.norm()) < 0.04  # 20,000 draws: 1 % each
    assert model.means[0].norm().item() == 0.0  # sigmoid(-99.5) x 50 Sigma z


@pytest.mark.parametrize(("cap", "added"), [(None, 42), (70, 50), (1_000, 80)])
def test_without_a_cap_growth_ends_at_what_the_pixels_ask_for(cap, added):
    model, optimizer = model_of([0.5] * 20)
    view = SimpleNamespace(camera=SimpleNamespace(width=2, height=1))
    state = SimpleNamespace(model=model, optimizer=optimizer, step=600, scene=SimpleNamespace(train=[view, view]))
    assert MCMC(cap=cap, growth=4.0).add(state) == {"added": added}  # 62.5 for four pixels, which rounds to even


def test_a_run_of_the_same_stream_draws_the_same():
    digests = []
    for seed in (1, 1, 2):
        model, optimizer = model_of([0.001] * 10 + [0.3] * 50)
        relocate(model, optimizer, stream(seed, "r"))
        grow(model, optimizer, stream(seed, "g"))
        add_noise(model, stream(seed, "n"), lr=1e-3)
        digests.append(model.digest())
    assert digests[0] == digests[1] != digests[2]


def test_rows_that_do_not_fit_are_refused():
    model, optimizer = model_of([0.5] * 4)
    with pytest.raises(ShapeError, match=r"'means' must be .*\[2, 3\], got \[1, 3\]"):
        optimizer.set_rows(model, torch.tensor([0, 1]), {"means": torch.zeros(1, 3)})
    with pytest.raises(ShapeError, match="'colour' is not among the rows of"):
        optimizer.set_rows(model, torch.tensor([0]), {"colour": torch.zeros(1)})


def test_set_rows_leaves_no_parameter_to_be_updated_in_this_step():
    model, optimizer = model_of([0.5] * 4)
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.set_rows(model, torch.tensor([2]), {"means": torch.zeros(1, 3)})
    before = model.digest()
    optimizer.step()
    assert model.digest() == before
    assert not model.means[2].any()
