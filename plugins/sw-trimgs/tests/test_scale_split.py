"""Scale split: large Gaussians become three children, in their plane, inside the room around the cameras."""

import math

import pytest
import torch
from sw_gaussians.density.splitting import rotate
from sw_gaussians.surfels import SurfelModel

from splatwizard_core.errors import EmptyModel
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from splatwizard_core.training.stage import CameraIterator
from splatwizard_core.training.task_log import TaskLog
from sw_trimgs.scale_split import ScaleSplit, camera_box, split_rows, too_large

CENTERS = torch.tensor([[-1.0, -0.5, 0.0], [1.0, 0.5, 0.0]])


def optimizer_of(model):
    return SplatOptimizer(model, [ParamGroup(name, 1e-3) for name, _ in model.named_parameters()])


def surfel(scale=1.0):
    return SurfelModel(
        torch.tensor([[0.1, 0.2, 0.1], [0.2, 0.0, 0.0]]), torch.randn(2, 1, 3), torch.zeros(2, 0, 3), torch.ones(2),
        torch.tensor([[scale, 0.5], [0.01, 0.02]]).log(), torch.tensor([[0.9, 0.1, -0.3, 0.2], [1.0, 0, 0, 0]]),
    )  # fmt: skip


def test_one_large_surfel_becomes_three_in_its_plane():
    model = surfel()
    parent = {name: value.detach().clone() for name, value in model.named_parameters()}
    assert split_rows(model, optimizer_of(model), torch.tensor([True, False])) == 1
    assert model.num_rows == 4
    assert torch.equal(model.means[0], parent["means"][1])  # survivors come first
    normal = rotate(parent["quats"][:1], torch.tensor([[0.0, 0.0, 1.0]]))
    offsets = model.means[1:].detach() - parent["means"][0]
    assert float((offsets @ normal.T).abs().max()) < 1e-6
    assert float(offsets.norm(dim=1).min()) > 0
    assert torch.allclose(model.scales[1:], parent["log_scales"][0].exp().expand(3, 2) / 2.4)
    for name in ("sh_dc", "opacity_logits", "quats"):
        assert torch.equal(getattr(model, name)[1:], parent[name][:1].expand(3, *parent[name].shape[1:]))


def test_splits_are_a_function_of_the_models_stream():
    first, second = surfel(), surfel()
    second.sh_dc.data = first.sh_dc.data.clone()
    for model in (first, second):
        split_rows(model, optimizer_of(model), torch.tensor([True, True]))
    assert first.digest() == second.digest()
    again = surfel()
    again.split_seed = 5
    split_rows(again, optimizer_of(again), torch.tensor([True, True]))
    assert not torch.equal(again.means, first.means)


def test_the_box_has_twice_the_span_of_the_cameras():
    middle, half = camera_box(CENTERS)
    assert middle.tolist() == [0, 0, 0]
    assert half.tolist() == [2.0, 1.0, 0.5]  # flat in z: a quarter of the longest side
    assert camera_box(CENTERS, "xx")[1].tolist() == [2.0, 1.0, 2.0]


def test_what_is_outside_the_box_or_small_is_left_alone(make):
    model = make.gaussians([[0.0, 0, 0], [0, 0, 0.6], [0, 0, 0], [1.9, 0.9, 0]], [0.5] * 4, [1.0, 1.0, 0.1, 0.3])
    chosen = too_large(model, CENTERS, limit=0.2, size_px=None)
    assert chosen.tolist() == [True, False, False, True]
    assert too_large(model, CENTERS, limit=0.2, size_px=None, box="xx").tolist() == [True, True, False, True]


def test_a_large_radius_on_screen_is_enough(make):
    model = make.gaussians([[0.0, 0, 0]] * 2, [0.5] * 2, [0.1, 0.1])
    model.max_radii2d += torch.tensor([101.0, 100.0])
    assert too_large(model, CENTERS, limit=1, size_px=100).tolist() == [True, False]
    assert not too_large(model, CENTERS, limit=1, size_px=None).any()


def call(task, model, scene, step=3, iterations=10):
    from splatwizard_core.training.params import OptimizationParams

    log = TaskLog()
    task(
        model, optimizer_of(model), CameraIterator(scene.train), scene, OptimizationParams(iterations=iterations),
        step, log,
    )  # fmt: skip
    return {name.rpartition(".")[2]: float(value) for name, value in log.scalars.items()}


def test_the_task_splits_prunes_what_is_faint_and_clears_the_statistics(make, toy):
    limit = 0.01 * toy.scene.extent
    means = [[0.0, 0.0, -3.0]] * 4
    model = make.gaussians(means, [0.5, 0.5, 0.004, 0.006], [2.1 * limit, 1.9 * limit, limit, limit])
    model.grad_accum += 1
    found = call(ScaleSplit(factor=2.0), model, toy.scene)
    assert list(found.values()) == [1, 1]
    assert model.num_rows == 3 - 1 + 3
    assert float(model.opacities.detach().min()) == pytest.approx(0.006, rel=1e-4)
    assert not model.grad_accum.any()


def test_what_is_huge_goes_where_that_is_asked_for(make, toy):
    huge = math.log(2.4 * 0.2 * toy.scene.extent)
    model = make.gaussians([[0.0, 0.0, -3.0]] * 2, [0.5] * 2, [1e-3, 1e-3])
    model.log_scales.data[0] = huge
    call(ScaleSplit(world_prune=0.1), model, toy.scene)
    assert model.num_rows == 1


def test_the_last_step_is_left_in_peace_and_nothing_left_is_an_error(make, toy):
    model = make.gaussians([[0.0, 0.0, 0.0]], [0.001], [0.1])
    call(ScaleSplit(), model, toy.scene, step=10)
    assert model.num_rows == 1
    with pytest.raises(EmptyModel):
        call(ScaleSplit(), model, toy.scene, step=9)
