"""Sensitivity: closed form for one splat, finite differences, absolute values view by view, and the pruner."""

import pytest
import torch
from sw_gaussians.finetune.pruning import scores_of

from splatwizard_core.api import SH, CameraIterator, GaussianInputs, GaussianModel, RasterOptions
from sw_c3dgs.sensitivity import Sensitivity, sensitivities
from sw_c3dgs.shapes import UPPER, split_scales

SH_C0 = 0.28209479177387814


def of(model, cameras, rasterizer):
    log_factors, shapes = split_scales(model.log_scales.detach())
    return sensitivities(
        cameras, rasterizer, means=model.means, opacities=model.opacities, log_factors=log_factors, shapes=shapes,
        quats=model.quats, sh_dc=model.sh_dc, sh_rest=model.sh_rest,
    )  # fmt: skip


def single(degree=0, mean=(0.0, 0.0, 0.0)):
    rest = torch.zeros(1, (degree + 1) ** 2 - 1, 3)
    return GaussianModel(
        torch.tensor([mean]), torch.full((1, 1, 3), -5.0), rest, torch.tensor([0.5]),
        torch.tensor([[-1.0, -1.5, -1.2]]), torch.tensor([[1.0, 0.2, 0.0, 0.1]]),
    )  # fmt: skip


def test_one_splat_has_the_closed_form(make, rasterizer):
    """E is linear in the colour, which is not clamped: dE / d dc = 0.282 sum of alpha T, although it is far below 0."""
    camera = make.camera([0.0, 0.0, -4.0])
    model = single()
    ones = GaussianInputs(
        means=model.means.detach(), opacities=model.opacities.detach(), scales=model.scales.detach(),
        quats=model.quats.detach(), colors=torch.ones(1, 1),
    )  # fmt: skip
    covered = float(rasterizer.render(ones, camera, RasterOptions()).image.sum())
    color, _ = of(model, [camera], rasterizer)
    assert covered > 10
    assert float(color) == pytest.approx(SH_C0 * covered / (48 * 36), rel=1e-5)


def test_higher_bands_count_where_they_are_stronger(make, rasterizer):
    camera = make.camera([0.0, 0.0, -4.0])
    low, high = (float(of(single(degree), [camera], rasterizer)[0]) for degree in (0, 3))
    assert high > 1.5 * low  # along an axis, band 2 is 0.63 where band 0 is 0.28


def test_what_is_outside_every_frustum_has_none(make, rasterizer):
    color, shape = of(single(mean=(0.0, 0.0, -50.0)), [make.camera([0.0, 0.0, -4.0])], rasterizer)
    assert (float(color), float(shape)) == (0, 0)


def test_the_shape_agrees_with_finite_differences(make, rasterizer):
    camera = make.camera([0.0, 0.0, -4.0], width=16, height=16)
    model = single()
    log_factors, shapes = split_scales(model.log_scales.detach().double())
    quats = model.quats.detach().double()
    from sw_reference.projection import covariances

    matrix = covariances(shapes, quats).flatten(1)[:, UPPER]

    def total(found):
        drawn = GaussianInputs(
            means=model.means.detach().double(), opacities=model.opacities.detach().double(),
            cov3d=found * torch.exp(2 * log_factors)[:, None], sh=SH(dc=model.sh_dc.detach().double(), active_degree=0),
        )  # fmt: skip
        return float(rasterizer.render(drawn, camera, RasterOptions(clamp_color=False)).image.sum())

    differences = []
    for at in range(6):
        step = torch.zeros(1, 6, dtype=torch.float64)
        step[0, at] = 1e-4
        differences.append(abs(total(matrix + step) - total(matrix - step)) / 2e-4)
    _, shape = of(model, [camera], rasterizer)
    # The cut at alpha = 1/255 moves with the shape: a step of the sum that a derivative does not see.
    assert float(shape) == pytest.approx(max(differences) / 256, rel=0.03)


def test_absolute_values_are_taken_of_each_view(make, rasterizer):
    """Odd SH coefficients have opposite signs from opposite sides: their sum over views is 0, that of sizes is not."""
    cameras = [make.camera([0.0, 0.0, z]) for z in (-4.0, 4.0)]
    model = single(degree=1)
    both, _ = of(model, cameras, rasterizer)
    each = [float(of(model, [camera], rasterizer)[0]) for camera in cameras]
    assert float(both) == pytest.approx(sum(each) / 2, rel=1e-4)
    assert float(both) > 0.4 * max(each)


def test_the_gaussians_keep_no_gradient(make, rasterizer):
    model = make.cloud(20)
    with torch.no_grad():  # as schedule tasks run
        of(model, [make.camera([0.0, 0.0, -4.0])], rasterizer)
    assert all(parameter.grad is None for parameter in model.parameters())


@pytest.mark.parametrize("kind", ["color", "shape"])
def test_any_method_may_prune_by_it(make, toy, plugins, rasterizer, kind):
    pruner = plugins.pruners.load("sensitivity")(kind=kind)
    assert isinstance(pruner, Sensitivity)
    model = make.cloud(50)
    model.means.data[3] = torch.tensor([0.0, 0.0, 500.0])
    model.means.data[3, 1] = 500.0
    scores = scores_of(pruner, model, CameraIterator(toy.scene.train), rasterizer, toy.scene)
    color_and_shape = of(model, [view.camera for view in toy.scene.train], rasterizer)
    assert torch.equal(scores, color_and_shape[kind == "shape"])
    assert float(scores[3]) == 0


def test_other_models_have_no_score(toy, rasterizer):
    with pytest.raises(TypeError, match="GaussianModel"):
        Sensitivity().score(torch.nn.Linear(1, 1), [], rasterizer)
