"""Adaptive density control on four Gaussians, worked out by hand."""

import math

import pytest
import torch
from sw_gaussians.density.adc import densify_and_prune, reset_opacity
from sw_gaussians.density.splitting import rotate
from sw_gaussians.stage import increase_sh_degree
from sw_gaussians.start import logit
from sw_gaussians.statistics import accumulate_statistics

from splatwizard_core.errors import EmptyModel
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.streams import stream
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer

EXTENT = 10.0  # scales up to 0.1 are cloned, above 1.0 are pruned once resets are past
SMALL, LARGE, HUGE = math.log(0.05), math.log(0.5), math.log(2.0)
NAMES = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")


def four(log_scales=(SMALL, LARGE, SMALL, LARGE), opacities=(0.5, 0.5, 0.5, 0.5)) -> GaussianModel:
    """Four Gaussians whose every value tells the row that it came from."""
    row = torch.arange(4.0)
    model = GaussianModel(
        row[:, None].repeat(1, 3),
        row[:, None, None].repeat(1, 1, 3),
        row[:, None, None].repeat(1, 3, 3),
        torch.tensor([logit(o) for o in opacities]),
        torch.tensor(log_scales)[:, None].repeat(1, 3),
        torch.tensor([[1.0, 0, 0, 0]] * 4),
    )
    model.split_seed = 11
    return model


def seen(model: GaussianModel, mean_gradients: list[float], views: int = 2) -> None:
    """As if each Gaussian had been seen `views` times with this gradient; None: never."""
    for i, g in enumerate(mean_gradients):
        if g is not None:
            model.grad_accum[i], model.denom[i] = g * views, views


def optimizer_after_one_step(model: GaussianModel) -> SplatOptimizer:
    optimizer = SplatOptimizer(model, [ParamGroup(name, lr=0.0) for name in NAMES])
    for parameter in model.parameters():
        parameter.grad = torch.arange(1.0, 5.0).reshape(4, *[1] * (parameter.dim() - 1)).expand_as(parameter).clone()
    optimizer.step()
    return optimizer


def test_order_is_survivors_then_clones_then_first_and_second_children():
    model = four()
    optimizer = optimizer_after_one_step(model)
    seen(model, [3e-4, 3e-4, 1e-4, 2e-4])  # 0 is cloned, 1 and 3 are split (>=), 2 stays
    report = densify_and_prune(model, optimizer, step=600, extent=EXTENT)
    assert report == {"cloned": 1, "split": 2, "pruned": 0}
    assert model.sh_dc[:, 0, 0].tolist() == [0, 2, 0, 1, 3, 1, 3]


def test_clones_are_exact_copies_and_children_are_smaller_copies():
    model = four()
    seen(model, [3e-4, 3e-4, None, None])
    before = {name: getattr(model, name).detach().clone() for name in NAMES}
    densify_and_prune(model, optimizer_after_one_step(model), step=600, extent=EXTENT)
    # survivors 0, 2, 3; the clone of 0; two children of 1
    for name in NAMES:
        after = getattr(model, name).detach()
        assert torch.equal(after[:4], before[name][[0, 2, 3, 0]]), name
        if name not in ("means", "log_scales"):
            assert torch.equal(after[4:], before[name][[1, 1]]), name
    torch.testing.assert_close(model.scales[4:], torch.full((2, 3), 0.5 / 1.6))


def test_children_are_drawn_from_the_parent_by_the_models_own_stream():
    model = four()
    with torch.no_grad():
        model.log_scales[1] = torch.tensor([math.log(0.5), math.log(0.2), math.log(0.1)])
        model.quats[1] = torch.tensor([1.0, 0.0, 0.0, 1.0])  # a quarter turn about z, not normalised
    seen(model, [None, 3e-4, None, None])
    densify_and_prune(model, optimizer_after_one_step(model), step=600, extent=EXTENT)
    z = torch.randn(2, 3, generator=stream(11, "split/0")) * torch.tensor([0.5, 0.2, 0.1])
    expected = 1.0 + torch.stack([-z[:, 1], z[:, 0], z[:, 2]], dim=1)
    torch.testing.assert_close(model.means[3:].detach(), expected)


def test_rotation_by_a_quaternion_agrees_with_its_matrix():
    g = torch.Generator().manual_seed(0)
    q, v = torch.randn(20, 4, generator=g), torch.randn(20, 3, generator=g)
    w, x, y, z = torch.nn.functional.normalize(q, dim=1).T
    matrix = torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ], dim=1,
    ).reshape(-1, 3, 3)  # fmt: skip
    torch.testing.assert_close(rotate(q, v), (matrix @ v[:, :, None])[:, :, 0], atol=1e-5, rtol=1e-5)


def test_moments_follow_their_rows_and_start_at_zero_for_new_ones():
    model = four()
    optimizer = optimizer_after_one_step(model)
    seen(model, [3e-4, 3e-4, None, None])
    densify_and_prune(model, optimizer, step=600, extent=EXTENT)
    for name in NAMES:
        exp_avg, exp_avg_sq, step = optimizer.moments(name)
        assert step == 1
        rows = exp_avg.reshape(6, -1)[:, 0]
        torch.testing.assert_close(rows, 0.1 * torch.tensor([1.0, 3.0, 4.0, 0.0, 0.0, 0.0]))
        torch.testing.assert_close(
            exp_avg_sq.reshape(6, -1)[:, 0], 1e-3 * torch.tensor([1.0, 9.0, 16.0, 0.0, 0.0, 0.0])
        )
        assert getattr(model, name).grad is None  # so that this step updates nothing


def test_statistics_start_again_even_if_nothing_was_added():
    model = four()
    seen(model, [1e-4, 1e-4, 1e-4, 1e-4])
    model.max_radii2d += 3
    optimizer = optimizer_after_one_step(model)
    densify_and_prune(model, optimizer, step=600, extent=EXTENT)
    assert model.num_rows == 4
    for name in ("grad_accum", "denom", "max_radii2d"):
        assert not getattr(model, name).any()
    assert all(getattr(model, name).grad is None for name in NAMES)


def test_a_gaussian_never_seen_is_left_alone():
    model = four()
    densify_and_prune(model, optimizer_after_one_step(model), step=600, extent=EXTENT)
    assert model.num_rows == 4


@pytest.mark.parametrize(
    ("step", "survivors"),
    [
        (600, [0, 1, 2]),  # only the faint one goes
        (3000, [0, 1, 2]),  # the size rule asks for s > 3000
        (3100, [0, 1]),
    ],
)
def test_faint_ones_are_pruned_always_and_huge_ones_after_the_first_reset(step, survivors):
    model = four(log_scales=(SMALL, LARGE, HUGE, LARGE), opacities=(0.5, 0.006, 0.5, 0.004))
    densify_and_prune(model, optimizer_after_one_step(model), step=step, extent=EXTENT)
    assert model.sh_dc[:, 0, 0].tolist() == survivors


@pytest.mark.parametrize(("limit", "survivors"), [(None, [0, 1, 2, 3]), (20.0, [0, 2, 3])])
def test_the_screen_rule_is_off_unless_asked_for_and_reads_the_radii_before_densification(limit, survivors):
    model = four()
    model.max_radii2d[1] = 21
    model.max_radii2d[2] = 20
    densify_and_prune(model, optimizer_after_one_step(model), step=3100, extent=EXTENT, prune_screen_px=limit)
    assert model.sh_dc[:, 0, 0].tolist() == survivors


def test_revised_opacity_makes_two_children_as_opaque_as_their_parent():
    model = four(opacities=(0.5, 0.75, 0.5, 0.5))
    seen(model, [3e-4, 3e-4, None, None])
    densify_and_prune(model, optimizer_after_one_step(model), step=600, extent=EXTENT, revised_opacity=True)
    torch.testing.assert_close(model.opacities[3:], torch.tensor([0.5, 0.5, 0.5]))  # clone of 0, children of 1


def test_nothing_left_is_an_empty_model():
    model = four(opacities=(0.001,) * 4)
    with pytest.raises(EmptyModel, match="step 700"):
        densify_and_prune(model, optimizer_after_one_step(model), step=700, extent=EXTENT)


def test_the_same_seed_splits_alike():
    models = [four(), four()]
    for model in models:
        seen(model, [None, 3e-4, None, 3e-4])
        densify_and_prune(model, optimizer_after_one_step(model), step=600, extent=EXTENT)
    assert models[0].digest() == models[1].digest()


def test_statistics_add_up_visible_gaussians_only():
    model = four()
    gradients = torch.tensor([[3.0, 4.0], [1.0, 0.0], [math.nan, 1.0], [0.0, 2.0]])
    accumulate_statistics(model, gradients, torch.tensor([2, 7, 0, 1], dtype=torch.int32))
    accumulate_statistics(model, gradients, torch.tensor([1, 0, 0, 5], dtype=torch.int32))
    assert model.grad_accum.tolist() == [10, 1, 0, 4]
    assert model.denom.tolist() == [2, 1, 0, 2]
    assert model.max_radii2d.tolist() == [2, 7, 0, 5]


def test_pixel_gradients_in_ndc_units_select_the_same_set():
    """A rasterizer that has dL/du in pixels reports (W/2, H/2) times it; both then select the same Gaussians."""
    width, height = 640, 480
    ndc = torch.tensor([[1.5e-4, 1.5e-4], [1e-4, 0.0], [0.0, 2.1e-4], [1.9e-4, 0.0]])
    pixels = ndc / torch.tensor([width / 2, height / 2])
    selected = []
    for gradients in (ndc, pixels * torch.tensor([width / 2, height / 2])):
        model = four(log_scales=(SMALL,) * 4)
        accumulate_statistics(model, gradients, torch.ones(4, dtype=torch.int32))
        densify_and_prune(model, optimizer_after_one_step(model), step=600, extent=EXTENT)
        selected.append(model.sh_dc[4:, 0, 0].tolist())
    assert selected == [[0, 2], [0, 2]]


def test_reset_lowers_opacities_and_clears_their_moments_only():
    model = four(opacities=(0.9, 0.004, 0.01, 0.5))
    optimizer = optimizer_after_one_step(model)
    kept = optimizer.moments("means")[0].clone()
    before = model.opacity_logits[1].item()
    reset_opacity(model, optimizer)
    torch.testing.assert_close(model.opacities, torch.tensor([0.01, 0.004, 0.01, 0.01]), atol=0, rtol=1e-5)
    assert model.opacity_logits[1].item() == before
    exp_avg, exp_avg_sq, step = optimizer.moments("opacity_logits")
    assert not exp_avg.any()
    assert not exp_avg_sq.any()
    assert step == 1
    assert torch.equal(optimizer.moments("means")[0], kept)
    assert model.opacity_logits.grad is None


def test_sh_degree_rises_to_the_models_own_and_stops():
    model = four()
    model.active_sh_degree = 0
    increase_sh_degree(model)
    assert model.active_sh_degree == 1
    increase_sh_degree(model)
    assert model.active_sh_degree == model.max_sh_degree == 1
