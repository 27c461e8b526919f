"""Updates that are offered to the backward pass: when, to whom, and what is left to the optimizer."""

from types import SimpleNamespace

import pytest
import torch
from sw_gaussians.config import GaussianTraining
from sw_gaussians.control_tasks import Collect
from sw_gaussians.fast.fused_adam import OFFERED, FusingOptimizer
from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.api import ConfigError
from splatwizard_core.scene.scene import PointCloud
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers
from splatwizard_native import AdamUpdate, adam_steps, end_offer, offer_update, offered_update


def made(kind):
    generator = torch.Generator().manual_seed(4)
    points = PointCloud(torch.rand(9, 3, generator=generator), torch.rand(9, 3, generator=generator))
    model = gaussians_from_points(points, max_sh_degree=1)
    return model, kind(model, [ParamGroup(name, lr=0.01) for name, _ in model.named_parameters()])


def give_gradients(model, seed):
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        parameter.grad = torch.randn(parameter.shape, generator=generator)


def test_an_offer_waits_until_it_is_done_or_withdrawn():
    x = torch.zeros(3)
    assert offered_update(x) is None
    assert not end_offer(x)
    update = AdamUpdate(x, x, x, x, 0.1, 0.9, 0.999, 1e-15, 1)
    offer_update(x, update)
    assert offered_update(x) is update
    assert end_offer(x)
    assert offered_update(x) is None
    assert not end_offer(x)


def test_on_a_cpu_nothing_is_offered_and_the_steps_are_those_of_adam():
    (ours, optimizer), (theirs, plain) = made(FusingOptimizer), made(SplatOptimizer)
    for seed in range(3):
        optimizer.offer()
        assert all(offered_update(getattr(ours, name)) is None for name in OFFERED)
        for model, each in ((ours, optimizer), (theirs, plain)):
            give_gradients(model, seed)
            each.step()
    assert all(torch.equal(a, b) for a, b in zip(ours.parameters(), theirs.parameters(), strict=True))


@pytest.mark.parametrize("taken", [(), ("sh_rest",), OFFERED])
def test_what_a_backward_pass_has_done_is_counted_and_the_rest_is_done(taken):
    (ours, optimizer), (theirs, plain) = made(FusingOptimizer), made(SplatOptimizer)
    for seed in range(3):
        for model in (ours, theirs):
            give_gradients(model, seed)
        if seed > 0:
            optimizer._offer_all(OFFERED)
            for name in taken:  # as a kernel would
                param = getattr(ours, name)
                update = offered_update(param)
                assert update is not None
                update.grad, param.grad = param.grad, None
                adam_steps([update])
                torch.autograd.graph.increment_version(param)
        optimizer.step()
        plain.step()
    for name, parameter in ours.named_parameters():
        assert torch.equal(parameter, dict(theirs.named_parameters())[name]), name
        assert optimizer.moments(name)[2] == plain.moments(name)[2] == 3
        assert offered_update(parameter) is None


def test_it_is_offered_where_no_task_but_the_statistics_follows(monkeypatch):
    config = GaussianTraining.model_validate(
        {"iterations": 40, "density": {"settings": {"start": 10, "stop": 30, "interval": 5, "reset_interval": 12}}}
    )
    stage = ThreeDGSStage(config)
    _, post = build_schedulers(stage, PipelineParams())
    _, stage._optimizer = made(FusingOptimizer)
    offered = []
    monkeypatch.setattr(FusingOptimizer, "offer", lambda self: offered.append(step))
    background = torch.zeros(3)
    for step in range(1, 41):
        stage.raster_options(step, background)
    assert offered == []  # unless it is asked for
    stage.fuses_updates = None
    for step in range(1, 41):
        stage.raster_options(step, background)
    assert offered == []  # or there are many Gaussians
    monkeypatch.setattr("sw_gaussians.fast.fused_adam.MIN_FUSED_GAUSSIANS", stage._optimizer.model.num_rows)
    stage.raster_options(step := 2, background)
    assert offered == [2]
    offered.clear()
    stage.fuses_updates = True
    for step in range(1, 41):
        stage.raster_options(step, background)
    others = {step for entry in post.registrations if not isinstance(entry.task, Collect)
              for step in range(1, 41) if entry.due(step)}  # fmt: skip
    assert len(others) > 4
    assert offered == [step for step in range(1, 40) if step not in others]
    offered.clear()
    post.register_task(range(0, 40), lambda: None, name="of a stranger")
    for step in range(1, 41):
        stage.raster_options(step, background)
    assert offered == []


def test_a_stage_made_of_this_one_offers_nothing(monkeypatch):
    class Other(ThreeDGSStage):
        pass

    stage = Other(GaussianTraining(), fuses_updates=True)
    build_schedulers(stage, PipelineParams())
    _, stage._optimizer = made(FusingOptimizer)
    monkeypatch.setattr(FusingOptimizer, "offer", lambda self: pytest.fail("offered"))
    stage.raster_options(3, torch.zeros(3))


def test_it_is_refused_beside_the_sparse_optimizer():
    with pytest.raises(ConfigError, match="fused_updates"):
        ThreeDGSStage(GaussianTraining(sparse_adam=True), fuses_updates=True)


def test_it_is_refused_on_a_cpu_if_it_is_asked_for():
    model, _ = made(FusingOptimizer)
    scene = SimpleNamespace(protocol=SimpleNamespace(background="black"))
    context = SimpleNamespace(model=model, scene=scene, generator=lambda name: torch.Generator())
    with pytest.raises(ConfigError, match="CUDA"):
        ThreeDGSStage(GaussianTraining(), fuses_updates=True).begin(context)
    assert ThreeDGSStage(GaussianTraining(), fuses_updates=None).begin(context) is model
    assert ThreeDGSStage(GaussianTraining(sparse_adam=True), fuses_updates=None).fuses_updates is None
