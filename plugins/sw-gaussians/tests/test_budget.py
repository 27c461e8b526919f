"""Density control with a budget: the draw, the target, what is copied and what gets a child, halving, Morton order."""

import math

import pytest
import torch
from sw_gaussians.density import fragments
from sw_gaussians.density.budget import densify_to_budget, draw_distinct, halve_opacity, linear_target
from sw_gaussians.fast_tasks import DensifyToBudget
from sw_gaussians.morton import morton_order
from sw_gaussians.ply import export_ply, load_ply
from sw_gaussians.start import logit
from sw_gaussians.statistics import collect_statistics
from sw_reference.rasterizer import ReferenceRasterizer

from splatwizard_core.api import (
    Camera,
    EmptyModel,
    GaussianModel,
    GradBuffer,
    ParamGroup,
    RasterOptions,
    RenderResult,
    SplatOptimizer,
    stream,
)

EXTENT = 10.0  # largest scales up to 0.1 are copied
SMALL, LARGE = math.log(0.05), math.log(0.5)


def model_of(n: int, *, log_scale: float = SMALL, opacity: float = 0.5) -> GaussianModel:
    """Gaussians on a line, whose every value tells the row that it came from."""
    row = torch.arange(float(n))
    model = GaussianModel(
        row[:, None].repeat(1, 3),
        row[:, None, None].repeat(1, 1, 3),
        row[:, None, None].repeat(1, 3, 3),
        torch.full((n,), logit(opacity)),
        torch.full((n, 3), log_scale),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
    )
    fragments.add_buffer(model)
    return model


def optimizer_of(model: GaussianModel) -> SplatOptimizer:
    """Adam after one step of rate 0, so that there are moments: those of row i are made of a gradient i + 1."""
    optimizer = SplatOptimizer(model, [ParamGroup(name, lr=0.0) for name in GaussianModel.RAW])
    for p in model.parameters():
        p.grad = torch.arange(1.0, len(p) + 1).reshape(-1, *[1] * (p.dim() - 1)).expand_as(p).clone()
    optimizer.step()
    optimizer.zero_grad()
    return optimizer


def seen(model: GaussianModel, *, gradient: float = 1e-3, squares: list[float] | None = None) -> None:
    """As if each had been drawn in 10 fragments of one view; squares: sums of the squares of its opacity gradients."""
    model.grad_accum.fill_(gradient)
    model.denom.fill_(1)
    model.fragments[:, 1] = torch.tensor(squares or [1.0] * model.num_rows)
    model.fragments[:, 2] = 10


def test_variance_by_hand():
    sums = torch.tensor([[0.0, 4.0, 3.0], [3.0, 3.0, 3.0], [0.0, 0.0, 0.0]])
    # 3 * (4 / 4 - 0), 3 * (3 / 4 - (3 / 4)^2), nothing
    assert fragments.opacity_variance(sums).tolist() == pytest.approx([3.0, 0.5625, 0.0])


def test_a_draw_is_distinct_repeats_with_its_seed_and_takes_weight_0_last():
    weights = torch.tensor([0.0, 1.0, 2.0, 0.0, 3.0])
    first = draw_distinct(weights, 3, stream(0, "a"))
    assert first.tolist() == [1, 2, 4]
    assert set(draw_distinct(weights, 4, stream(1, "a")).tolist()) > {1, 2, 4}
    many = torch.rand(1000, generator=stream(2, "weights"))
    again = [draw_distinct(many, 300, stream(5, "a")) for _ in range(2)]
    assert torch.equal(*again)
    assert len(again[0].unique()) == 300
    assert not torch.equal(again[0], draw_distinct(many, 300, stream(6, "a")))


def test_draws_are_in_proportion_to_weights():
    weights = torch.tensor([1.0, 3.0])
    found = [int(draw_distinct(weights, 1, stream(seed, "a"))) for seed in range(2000)]
    assert sum(found) / 2000 == pytest.approx(0.75, abs=0.04)  # 4 standard deviations


def test_the_target_rises_linearly_and_is_the_cap_at_the_last_round():
    plan = {"first": 100, "last": 500, "start": 1000, "cap": 3000}
    assert [linear_target(step, **plan) for step in (50, 100, 300, 500, 900)] == [1000, 1000, 2000, 3000, 3000]
    assert linear_target(500, first=500, last=500, start=10, cap=20) == 20
    assert linear_target(5, first=10, last=10, start=10, cap=20) == 10
    assert linear_target(500, first=0, last=400, start=10, cap=5) == 10  # a cap takes nothing away


def test_without_a_bound_by_evidence_the_target_is_hit():
    model = model_of(40)
    optimizer = optimizer_of(model)
    model.opacity_logits.data[:4] = logit(0.001)
    for target in (50, 61, 100):
        seen(model, gradient=0.0)
        densify_to_budget(model, optimizer, step=1, extent=EXTENT, target=target, growth=0)
        assert model.num_rows == target


def test_evidence_bounds_what_is_added():
    model = model_of(40)
    seen(model, gradient=1e-5)
    model.grad_accum[:3] = 2e-4
    report = densify_to_budget(model, optimizer_of(model), step=1, extent=EXTENT, target=1000, growth=2.0)
    assert (report["cloned"], model.num_rows) == (6, 46)


def test_the_score_decides_who_gets_company():
    model = model_of(6)
    seen(model, squares=[0.0, 0.0, 0.0, 5.0, 0.0, 0.0])
    densify_to_budget(model, optimizer_of(model), step=1, extent=EXTENT, target=7, growth=0)
    assert model.means[:, 0].tolist() == [0, 1, 2, 3, 4, 5, 3]


def test_a_small_one_is_copied_and_a_large_one_stays_beside_a_smaller_child():
    model = model_of(2)
    model.log_scales.data[1] = LARGE
    optimizer = optimizer_of(model)
    seen(model)
    report = densify_to_budget(model, optimizer, step=1, extent=EXTENT, target=4, growth=0)
    assert (report["cloned"], report["split"]) == (1, 1)
    assert torch.equal(model.means[2], model.means[0])
    assert torch.equal(model.log_scales[:3], torch.tensor([[SMALL] * 3, [LARGE] * 3, [SMALL] * 3]))
    assert torch.allclose(model.log_scales[3], torch.full((3,), LARGE - math.log(1.6)))
    assert not torch.equal(model.means[3], model.means[1])
    assert float((model.means[3] - model.means[1]).detach().norm()) < 6 * 0.5
    moments, _, _ = optimizer.moments("means")
    assert (moments[:2] != 0).all()
    assert (moments[2:] == 0).all()
    assert (model.fragments == 0).all()
    assert (model.denom == 0).all()


def test_faint_ones_and_those_without_a_fragment_go():
    model = model_of(5)
    seen(model, gradient=0.0)
    model.opacity_logits.data[1] = logit(0.004)
    model.fragments[2, 2] = 0  # in view, but behind others
    model.fragments[3, 2], model.denom[3] = 0, 0  # out of view: nobody knows
    kept = model_of(5)
    kept.load_state_dict(model.state_dict())
    densify_to_budget(model, optimizer_of(model), step=1, extent=EXTENT, target=0)
    assert model.means[:, 0].tolist() == [0, 3, 4]
    densify_to_budget(kept, optimizer_of(kept), step=1, extent=EXTENT, target=0, prune_unused=False)
    assert kept.means[:, 0].tolist() == [0, 2, 3, 4]


def test_a_model_without_the_buffer_is_told_what_it_lacks():
    model = model_of(4)
    optimizer = optimizer_of(model)
    seen(model)
    fragments.drop_buffer(model)
    with pytest.raises(ValueError, match=r"add_buffer.*score=\"gradient\""):
        densify_to_budget(model, optimizer, step=1, extent=EXTENT, target=10)
    densify_to_budget(model, optimizer, step=1, extent=EXTENT, target=6, score="gradient")
    assert model.num_rows == 6


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"score": "nonsense"}, "nonsense"),
        ({"cap": -1}, "cap is -1"),
        ({"growth": -0.5}, "growth"),
        ({"interval": 0}, "interval"),
    ],
)
def test_settings_of_the_task_are_checked_when_it_is_made(settings, said):
    with pytest.raises(ValueError, match=said):
        DensifyToBudget(**settings)


def test_nothing_left_is_an_error():
    model = model_of(3, opacity=0.001)
    with pytest.raises(EmptyModel):
        densify_to_budget(model, optimizer_of(model), step=7, extent=EXTENT, target=10)


def test_halving_has_a_floor_and_leaves_no_moment():
    model = model_of(3)
    model.opacity_logits.data = torch.logit(torch.tensor([0.8, 0.02, 0.009]))
    optimizer = optimizer_of(model)
    halve_opacity(model, optimizer)
    assert torch.allclose(model.opacities, torch.tensor([0.4, 0.01, 1 / 128]), atol=1e-6)
    assert optimizer.moments("means") is None
    before = model.sh_dc.detach().clone()
    optimizer.groups["sh_dc"].lr = 0.1
    model.sh_dc.grad = torch.full_like(model.sh_dc, 1e-3)
    optimizer.step()
    assert torch.allclose(before - model.sh_dc, torch.full_like(before, 0.1))  # and not 3.2 times that


def test_morton_order_is_that_of_interleaved_bits():
    corners = torch.tensor([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
    shuffled = torch.randperm(8, generator=stream(0, "shuffle"))
    assert torch.equal(corners[shuffled][morton_order(corners[shuffled])], corners)
    same = torch.zeros(4, 3)
    assert morton_order(same).tolist() == [0, 1, 2, 3]
    assert morton_order(same[:0]).tolist() == []


def test_rows_in_morton_order_are_the_same_rows_with_their_moments():
    points = torch.rand(50, 3, generator=stream(1, "points"))
    model = model_of(50)
    model.means.data = points.clone()
    optimizer = optimizer_of(model)
    seen(model, gradient=0.0)
    densify_to_budget(model, optimizer, step=1, extent=EXTENT, target=0, morton=True)
    order = morton_order(points)
    assert torch.equal(model.means, points[order])
    assert torch.equal(model.sh_dc[:, 0, 0], order.float())
    moments, squares, _ = optimizer.moments("sh_dc")
    assert torch.allclose(moments[:, 0, 0], 0.1 * (order + 1.0))
    assert torch.allclose(squares[:, 0, 0], 0.001 * (order + 1.0) ** 2)


def drawn_once(model: GaussianModel) -> torch.Tensor:
    """[3,16,16] of one view, whose statistics the model has afterwards."""
    camera = Camera.look_at(
        torch.tensor([0.5, 0.5, -2.0]), torch.full((3,), 0.5), torch.tensor([0.0, 1, 0]), width=16, height=16, fov_x=0.6
    )
    rasterizer = ReferenceRasterizer()
    found = rasterizer.render(model.gaussians(camera, rasterizer), camera, RasterOptions(grad2d=True))
    found.image.square().mean().backward()
    collect_statistics(model, found)
    return found.image.detach()


def test_morton_order_changes_neither_picture_nor_statistics_nor_the_exported_set(tmp_path):
    draws, n = stream(2, "gaussians"), 30
    model = GaussianModel(
        torch.rand(n, 3, generator=draws), torch.rand(n, 1, 3, generator=draws), torch.rand(n, 3, 3, generator=draws),
        torch.rand(n, generator=draws), -3 + 0.5 * torch.randn(n, 3, generator=draws),
        torch.randn(n, 4, generator=draws),
    )  # fmt: skip
    optimizer = optimizer_of(model)
    order = morton_order(model.means.detach())
    assert order.tolist() != list(range(n))
    before = drawn_once(model)
    export_ply(model, tmp_path / "before.ply")
    statistics = {name: getattr(model, name).clone() for name in ("grad_accum", "denom", "max_radii2d")}
    assert bool((statistics["grad_accum"] > 0).any())
    optimizer.keep_rows(model, order)
    for name in statistics:
        getattr(model, name).zero_()
    after = drawn_once(model)
    export_ply(model, tmp_path / "after.ply")
    torch.testing.assert_close(after, before, rtol=0, atol=1e-6)
    for name, values in statistics.items():
        torch.testing.assert_close(getattr(model, name), values[order], rtol=1e-5, atol=1e-8)
    first, second = (load_ply(tmp_path / f"{name}.ply") for name in ("before", "after"))
    for name in GaussianModel.RAW:
        assert torch.equal(getattr(second, name), getattr(first, name)[order]), name


def test_opacity_gradients_are_added_view_by_view():
    model = model_of(3)
    model.opacity_logits.data = torch.tensor([0.0, 90.0, 0.0])
    found = GradBuffer()
    found.set(torch.tensor([[4.0, 2.0], [1.0, 1.0], [0.0, 0.0]]))
    result = RenderResult(torch.zeros(3, 1, 1), torch.ones(3, dtype=torch.int32), None, fragment_grad=found)
    fragments.collect_opacity_gradients(model, result)
    assert (model.fragments == 0).all()  # another task has taken the gradient
    model.opacity_logits.grad = torch.tensor([0.25, 1e-6, 0.0])
    for _ in range(2):
        fragments.collect_opacity_gradients(model, result)
    # g = dL/dlogit / (1 - o), and at least MIN_TRANSPARENCY is divided by
    torch.testing.assert_close(model.fragments, torch.tensor([[1.0, 8.0, 4.0], [2.0, 2.0, 2.0], [0.0, 0.0, 0.0]]))


def test_the_buffer_goes_as_it_came():
    model = model_of(3)
    assert "fragments" in model.state_dict()
    fragments.drop_buffer(model)
    assert "fragments" not in model.state_dict()
    assert model.ROWS == GaussianModel.ROWS
