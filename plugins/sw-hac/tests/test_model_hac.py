"""The model has the published sizes, predicts by the formulas, and learns through noise, masks and rate."""

import copy

import pytest
import torch
from hac_models import generator, make, method, predicted
from sw_anchors.coded_anchors import ENTROPY
from sw_anchors.testing import check_nothing_is_waited_for
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import front_camera

from splatwizard_core.errors import SceneError
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene
from sw_hac.method import HACStage

RASTERIZER = ReferenceRasterizer()


def published():
    points = PointCloud(torch.rand(60, 3, generator=generator(0)))
    scene = Scene("points", [], [], points, Protocol("test"))
    return method().create_model(scene, generator(1))


def test_sizes_are_the_published_ones():
    model = published()
    assert sum(p.numel() for network in model.networks().values() for p in network.parameters()) == 41_235
    assert model.grid.entries == 1_766_272
    assert model.mlp_grid[0].in_features == 96
    assert sum(model.shape.outputs) == 175
    assert sum(model.shape.widths) == 86
    assert bool((model.mask_logits == 1).all())


def test_a_scene_without_points_is_refused():
    with pytest.raises(SceneError, match="no start points"):
        method().create_model(Scene("none", [], [], None, Protocol("test")), generator(0))


def test_predictions_equal_the_formulas():
    model = make()
    rows = torch.tensor([7, 3, 250])
    u = model.codes()[rows] / 65535
    box = model.bounds[1] - model.bounds[0]
    torch.testing.assert_close(u, (model.positions()[rows] - model.bounds[0]) / box, atol=1e-5, rtol=0)
    out = model.mlp_grid(model.grid(u))
    mu_f, sigma_f, mu_l, sigma_l, mu_o, sigma_o, t_f, t_l, t_o = out.split([8, 8, 6, 6, 12, 12, 1, 1, 1], dim=1)
    found = predicted(model, rows)
    for mean, expected in zip(found.means, (mu_f, mu_l, mu_o), strict=True):
        torch.testing.assert_close(mean, expected)
    for scale, expected in zip(found.scales, (sigma_f, sigma_l, sigma_o), strict=True):
        torch.testing.assert_close(scale, expected)
    for step, t, base in zip(found.steps, (t_f, t_l, t_o), (1, 0.001, 0.2), strict=True):
        torch.testing.assert_close(step, base * (1 + torch.tanh(t)))


def test_steps_never_vanish():
    model = make()
    with torch.no_grad():
        model.mlp_grid[2].bias[-3:] = -40
    for step, base in zip(predicted(model, torch.arange(300)).steps, model.base_steps, strict=True):
        torch.testing.assert_close(step, torch.full_like(step, base / 64))


def training_loss(model, stage=None):
    """A step of the entropy phase, with its gradients."""
    model.train()
    cam = front_camera()
    result = RASTERIZER.render(model.gaussians(cam, RASTERIZER), cam, RasterOptions(grad2d=True))
    stage = stage or HACStage(method().config)
    terms = stage.extra_loss(model, result, 1)
    return result, {name: weight * term for name, (weight, term) in terms.items()}


def test_the_loss_has_rate_grid_and_mask_terms():
    model = make(sample=1.0)
    result, terms = training_loss(model)
    rate = result.extras["rate"]
    assert float(terms["rate"].detach()) == pytest.approx(0.001 * float(rate.bits.detach()))
    entropy_of_signs = float(model.grid.with_bits(torch.zeros(0, 3))[1].detach())
    assert float(terms["grid"].detach()) == pytest.approx(0.001 * entropy_of_signs / (300 * 26), rel=1e-5)
    soft = torch.sigmoid(model.mask_logits).mean()
    assert float(terms["masks"].detach()) == pytest.approx(5e-4 * float(soft.detach()))


def test_before_the_entropy_phase_there_is_no_rate():
    model = make()
    for phase in ("full precision", "quantized training"):
        model.phase = phase
        assert training_loss(model)[1] == {}


def test_gradients_of_the_rate_reach_grid_network_steps_masks_and_values():
    model = make(sample=1.0)
    _, terms = training_loss(model)
    sum(terms.values()).backward()
    for name in ("features", "offsets", "log_scales", "mask_logits"):
        assert float(getattr(model, name).grad.abs().max()) > 0, name
    assert all(float(grid.table.grad.abs().max()) > 0 for grid in model.grid.grids)
    steps = model.mlp_grid[2].bias.grad[-3:]
    assert bool((steps != 0).all())
    assert model.mlp_opacity[0].weight.grad is None


def test_gradients_of_the_picture_reach_masks_and_steps():
    model = make()
    result, _ = training_loss(model)
    result.image.square().sum().backward()
    assert float(model.mask_logits.grad.abs().max()) > 0
    assert bool((model.mlp_grid[2].bias.grad[-3:] != 0).all())  # through the noise


def test_prediction_may_start_from_statistics():
    model = make(n=500)
    kept = torch.nonzero(model.kept()).squeeze(1)
    model.start_from_statistics()
    found, values = predicted(model, kept), model.raw(kept)
    for mean, scale, value, base in zip(found.means, found.scales, values, model.base_steps, strict=True):
        torch.testing.assert_close(mean.mean(0), value.mean(0), atol=0.1 * float(value.detach().std()), rtol=0.1)
        torch.testing.assert_close(scale.mean(0), value.std(0).clamp(min=base), atol=0.05, rtol=0.2)


def test_a_single_huge_scale_does_not_widen_the_first_prediction():
    model = make(n=500)
    kept = torch.nonzero(model.kept()).squeeze(1)
    model.start_from_statistics()
    before = predicted(model, kept).scales[1].mean(0)
    with torch.no_grad():
        model.log_scales[kept[0]] = 8.0
    model.start_from_statistics()
    assert float(model.raw(kept)[1].detach().std(0).min()) > 100
    torch.testing.assert_close(predicted(model, kept).scales[1].mean(0), before, atol=0.01, rtol=0.5)


def test_predictions_in_steps_are_the_same_once_folded():
    model, rows = make(in_steps=True), torch.arange(40)
    before = predicted(model, rows)
    out = model.mlp_grid(model.grid(model.codes()[rows] / 65535))
    torch.testing.assert_close(before.means[1], out[:, 16:22] * 0.001)
    torch.testing.assert_close(before.scales[2], out[:, 40:52] * 0.2)
    model.fold_units()
    after = predicted(model, rows)
    for name in ("means", "scales", "steps"):
        for one, other in zip(getattr(before, name), getattr(after, name), strict=True):
            torch.testing.assert_close(one, other)


def test_the_state_of_grid_and_network_is_part_of_the_digest():
    model, other = make(seed=1), make(seed=2)
    assert model.digest() != other.digest()
    other.load_resized(model.state_dict())
    other.load_state_dict_extra(model.state_dict_extra())
    assert model.digest() == other.digest()
    assert model.phase == ENTROPY


@pytest.mark.parametrize("in_steps", [True, False])
@pytest.mark.parametrize("kernel", [True, False])
def test_what_training_forecasts_for_a_sample_is_what_is_predicted(in_steps, kernel, monkeypatch):
    if not kernel:
        monkeypatch.setattr("sw_hac.fast.sign_lookup.fits", lambda *_: False)
    model = make(in_steps=in_steps)
    rows, drawn = torch.tensor([7, 3, 250, 20]), torch.tensor([3, 1])
    parameters = [*model.mlp_grid.parameters(), *model.grid.parameters()]
    context, forecast = predicted(model, rows), model.rate_model.forecast(model.context_of(rows), drawn)
    sampled = model.rate_model.read(forecast.outputs)
    own_bits = model.grid.with_bits(*model.context_of(rows))[1]
    steps = torch.cat(context.steps, dim=1)
    expected = [torch.cat(parts, dim=1)[drawn] for parts in (context.means, context.scales)]
    expected = [steps, steps[drawn], *expected, own_bits]
    found = [torch.cat(parts, dim=1) for parts in (sampled.means, sampled.scales)]
    found = [forecast.steps, forecast.sample_steps, *found, forecast.own_bits]
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)
    gradients = [torch.autograd.grad(sum(part.square().sum() for part in each[:4]) + each[4], parameters)
                 for each in (found, expected)]  # fmt: skip
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_neither_values_nor_rate_are_waited_for():
    check_nothing_is_waited_for(make().cuda())


def test_a_copy_leaves_behind_where_anchors_lie():
    model = make(40)
    predicted(model, torch.arange(4))
    assert model._places is not None
    twin = copy.deepcopy(model)
    assert twin._places is None
    assert twin.digest() == model.digest()
