"""Parameter counts, view weights of the masks, the triplane's set-up, gradients, and the loss."""

import numpy as np
import pytest
import torch
from sw_anchors.coded_anchors import ENTROPY

from splatwizard_core.plugins import load_plugins
from splatwizard_core.streams import stream
from sw_cat_3dgs.config import CatConfig
from sw_cat_3dgs.context import CatContext
from sw_cat_3dgs.method import Cat3DGS


def count(module):
    return sum(p.numel() for p in module.parameters())


def test_counts_are_the_papers():
    context = CatContext(Cat3DGS(load_plugins(), CatConfig()).shape(), torch.Generator())
    assert count(context.network) == 60_975
    assert count(context.slices) == 14_390
    assert [count(arm) for arm in context.arms] == [1_058] * 3
    assert context.triplane.width == 432
    assert sum(context.shape.outputs) == 175
    assert sum(context.shape.widths) == 86


def test_all_networks_of_a_file_are_the_papers(little_scene):
    """92,399 weights besides the planes."""
    model = Cat3DGS(load_plugins(), CatConfig(voxel_size=0.05)).create_model(little_scene, stream(0, "init"))
    drawing = sum(count(getattr(model, name)) for name in model.NETWORKS)
    assert drawing == 13_860
    assert drawing + count(model.context) == 92_399


class Seeing:
    """A rasterizer whose cameras see given rows."""

    def __init__(self, seen):
        self.seen = seen

    def visible_filter(self, inputs, camera):
        radii = torch.zeros(len(inputs.means), dtype=torch.int32)
        radii[self.seen[id(camera)]] = 5
        return radii


class Eye:
    def to(self, device):
        return self


def test_masks_are_weighted_by_views_over_their_mean(begun):
    _, model, _ = begun(rate_term__view_factor=3.0)
    cameras = [Eye(), Eye()]
    model.count_views(cameras, Seeing({id(cameras[0]): [0, 1], id(cameras[1]): [1]}))
    mean = 3 / model.num_rows
    assert model.view_weights[:3].tolist() == pytest.approx([3 / mean, 6 / mean, 0])
    assert model.kept()[:3].tolist() == [True, True, False]  # what nobody sees is dropped
    assert not model.views_stale
    with torch.no_grad():
        model.mask_logits.fill_(np.log(0.011 / 0.989))
        model.view_weights.copy_(torch.linspace(0.5, 1.5, model.num_rows))
    assert model.kept().tolist() == (torch.sigmoid(model.mask_logits[:, 0]) * model.view_weights > 0.01).tolist()


def test_views_are_counted_again_when_as_many_anchors_came_as_went(begun, little_scene, rasterizer):
    from splatwizard_core.training.stage import CameraIterator

    stage, model, optimizer = begun()
    stage.update_cam_mask(model, CameraIterator(little_scene.train), rasterizer)
    first, n = model.view_weights.clone(), model.num_rows
    model.view_weights.fill_(-1)
    stage.update_cam_mask(model, CameraIterator(little_scene.train), rasterizer)
    assert (model.view_weights == -1).all()  # nothing changed: not counted
    with torch.no_grad():
        model.opacity_accum[0], model.anchor_denom[0] = 0, 1000  # one goes
    stage.adjust_anchor(model, optimizer, 30)
    assert model.num_rows == n - 1
    optimizer.append_rows(model, model.rows_at(torch.tensor([[50.0, 0, 0]]), torch.zeros(1, 8), 0.05))
    stage.update_anchor_bound(model)
    stage.update_cam_mask(model, CameraIterator(little_scene.train), rasterizer)
    assert model.num_rows == n
    assert model.view_weights[-1] == 0  # far off: no camera sees it
    assert (model.view_weights[:-1] > 0).sum() == (first[1:] > 0).sum()


@pytest.mark.parametrize("units", ["values", "steps"])
def test_setting_up_makes_planes_of_the_anchors_resolution_and_predicts_their_statistics(begun, units):
    stage, model, optimizer = begun(context__anchors_per_cell=4.0, context__units=units, context__start="statistics")
    with torch.no_grad():
        model.features.normal_(3.0, 2.0, generator=torch.Generator().manual_seed(0))
    assert model.context.resolution == 0
    stage.setup_triplane(model, optimizer)
    assert model.context.resolution == round((model.num_rows / 4) ** 0.5)
    context = model.context(model.places()[torch.arange(model.num_rows)])
    assert (context.means[0] - model.features.mean(0)).abs().max() < 0.1
    assert (context.scales[0] - model.features.std(0)).abs().max() < 0.1
    for step, base in zip(context.steps, (1.0, 0.001, 0.2), strict=True):
        assert step.detach() == pytest.approx(1.1 * base, rel=0.1)
    model.context.fold_units()
    folded = model.context(model.places()[torch.arange(model.num_rows)])
    for before, after in zip((*context.means, *context.scales), (*folded.means, *folded.scales), strict=True):
        assert torch.allclose(before, after, rtol=1e-4, atol=1e-7)
    places = model.places()
    assert places.min() >= 0
    assert places is model.places()  # kept while anchors and frame stay


def test_the_rate_reaches_planes_networks_and_attributes(begun, little_scene, rasterizer):
    stage, model, optimizer = begun(rate_term__sample=1.0)
    stage.setup_triplane(model, optimizer)
    model.count_views([v.camera for v in little_scene.train], rasterizer)
    model.phase = ENTROPY
    with torch.no_grad():
        for network in model.context.slices.networks.values():
            network[-1].weight.fill_(0.01)
    inputs = model.gaussians(little_scene.train[0].camera, rasterizer)
    inputs.extras["rate"].bits.backward()
    for name, p in model.named_parameters():
        learns = name.startswith(("context.triplane", "context.network", "context.slices", "features", "mask_logits"))
        assert (p.grad is not None and bool(p.grad.abs().sum() > 0)) >= learns, name
        assert not name.startswith("context.arms") or p.grad is None


def test_untrained_slices_refine_nothing_and_the_parts_sum_to_the_whole(begun, little_scene, rasterizer):
    stage, model, optimizer = begun(rate_term__sample=1.0)
    stage.setup_triplane(model, optimizer)
    model.phase = ENTROPY
    rows = torch.arange(model.num_rows)
    plain = model.context(model.places()[rows])
    means, scales = model.context.refined(plain.means, plain.scales, model.features[rows])
    assert torch.equal(means[0], plain.means[0])
    assert torch.equal(scales[0], plain.scales[0])
    inputs = model.gaussians(little_scene.train[0].camera, rasterizer)
    rate = inputs.extras["rate"]
    share = rate.numbers / (model.num_rows * sum(model.context.shape.widths))
    assert 0 < share <= 1
    assert float(rate.bits.detach()) <= float(rate.by_group.sum()) / rate.numbers + 1e-6


def test_planes_cost_what_their_spatial_models_say(begun):
    stage, model, optimizer = begun(context__anchors_per_cell=1.0)
    stage.setup_triplane(model, optimizer)
    with torch.no_grad():
        whole = float(model.context.triplane_bits(model.uniform))
        parts = np.mean([float(model.context.triplane_bits(model.uniform, 0.5)) for _ in range(20)])
    latents = sum(p.numel() for p in model.context.triplane.planes)
    assert 0.1 < whole / latents < 3
    assert parts == pytest.approx(whole, rel=0.05)
    model.context.triplane_bits(model.uniform).backward()
    assert all(p.grad is not None for p in model.context.arms.parameters())
    assert all(p.grad is not None for p in model.context.triplane.parameters())


def test_the_state_of_a_phase_survives_a_checkpoint(begun):
    stage, model, optimizer = begun()
    stage.setup_triplane(model, optimizer)
    stage.round_planes(model)
    stage.train_all_but_planes(model)
    model.views_stale = False
    _, again, _ = begun()
    again.load_resized(model.state_dict())
    again.load_state_dict_extra(model.state_dict_extra())
    assert again.digest() == model.digest()
    assert again.context.rounded
    assert [p.requires_grad for p in again.parameters()] == [p.requires_grad for p in model.parameters()]
    rows = torch.arange(5)
    assert torch.equal(again.context(again.places()[rows]).means[1], model.context(model.places()[rows]).means[1])


@pytest.mark.parametrize("values", [{}, {"context__refine": True}, {"context__units": "steps"}])
def test_what_training_forecasts_for_a_sample_is_what_is_predicted(begun, values):
    stage, model, optimizer = begun(**values)
    stage.setup_triplane(model, optimizer)
    stage.round_planes(model)
    with torch.no_grad():
        for network in model.context.slices.networks.values():
            network[-1].weight.fill_(0.01)
        for plane in model.context.triplane.planes:
            plane *= 100
    rows, drawn = torch.arange(model.num_rows).flip(0), torch.tensor([3, 1])
    learned = [p for name, p in model.context.named_parameters() if not name.startswith("arms")]
    noisy = torch.cat(model.raw(rows), dim=1).detach()
    context = model.context(model.places()[rows])
    refined = model.context.refined(context.means, context.scales, noisy[:, : model.features.shape[1]])
    forecast = model.rate_model.forecast(model.context_of(rows), drawn)
    mean, scale = model.rate_model.read(forecast, noisy[drawn])
    expected = [torch.cat(parts, dim=1) for parts in (context.steps, *refined)]
    expected = [expected[0], expected[1][drawn], expected[2][drawn]]
    found = [forecast.steps, mean, scale]
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)
    gradients = [torch.autograd.grad(sum(part.sum() for part in each), learned) for each in (found, expected)]
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)
