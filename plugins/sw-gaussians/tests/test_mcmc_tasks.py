"""3DGS-MCMC on the small procedural scene: its plan, what it reaches, and that stopping changes nothing."""

import math

import pytest
import torch
from sw_gaussians.mcmc_tasks import AddNoise, Grow, Relocate
from sw_gaussians.stage import ThreeDGSStage
from sw_kit import short_training
from sw_kit.short_training import psnr

from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.config import resolve
from splatwizard_core.scene.scene import Scene
from splatwizard_core.streams import stream
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingStopped
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from splatwizard_core.training.task_log import TaskLog
from sw_3dgs.method import ThreeDGS

PLAN = """\
Stage | Task               | Plan
------+--------------------+-----------------------
Pre   | add noise          | range(30000)
Pre   | update lr          | range(30000)
Pre   | increase SH degree | range(0, 30000, 1000)
Post  | relocate           | range(600, 25000, 100)
Post  | grow               | range(600, 25000, 100)"""
SHORT = {
    "iterations": 200, "lr.max_steps": 200, "sh_interval": 60, "density.settings.start": 40,
    "density.settings.stop": 180, "density.settings.interval": 20, "density.settings.cap": 700,
}  # fmt: skip


def method(**sets) -> ThreeDGS:
    return ThreeDGS(load_plugins(), resolve(ThreeDGS, "mcmc", sets={**SHORT, **sets}).config)


def stage_of(**sets) -> ThreeDGSStage:
    config = resolve(ThreeDGS, "mcmc", sets=sets).config
    return ThreeDGSStage(config, config.density.load(load_plugins()))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return short_training.demo()


def train(scene: Scene, **options):
    return short_training.train(method(), scene, NegotiatedRasterizer(load_plugins(), device="cpu"), **options)


@pytest.fixture(scope="module")
def whole(scene):
    return train(scene)


def test_the_plan_is_the_published_one():
    stage = stage_of()
    assert format_plan(*build_schedulers(stage, PipelineParams())) == PLAN


@pytest.mark.parametrize(
    ("sets", "steps"),
    [
        ({"iterations": 40_000}, 40_000),
        ({"lr.max_steps": 20_000}, 30_000),
        ({"iterations": 6_000, "scale_schedule": True}, 6_000),
        ({"iterations": 6_000}, 30_000),  # the plan of checkpoints of older releases
    ],
)
def test_noise_is_added_until_the_last_step_whatever_the_rates_do(sets, steps):
    stage = stage_of(**sets)
    pre, _ = build_schedulers(stage, PipelineParams())
    (entry,) = (entry for entry in pre.registrations if entry.name == "add noise")
    assert entry.when == range(steps)


def test_it_asks_for_no_statistics():
    options = method().stages()[0].raster_options(1, torch.zeros(3))
    assert not options.grad2d
    assert not options.absgrad


def test_the_start_is_half_opaque_and_small(scene):
    start = method().create_model(scene, stream(0, "init"))
    plain = ThreeDGS(load_plugins(), resolve(ThreeDGS, "paper").config).create_model(scene, stream(0, "init"))
    torch.testing.assert_close(start.opacities, torch.full((600,), 0.5))
    torch.testing.assert_close(start.scales, 0.1 * plain.scales)


@pytest.mark.pipeline
def test_it_learns_and_ends_at_the_cap(scene, whole):
    start, rasterizer = (
        method().create_model(scene, stream(0, "init")),
        NegotiatedRasterizer(load_plugins(), device="cpu"),
    )
    assert (
        psnr(whole.model, scene, rasterizer) > psnr(start, scene, rasterizer) + 4
    )  # 4.95 dB: what moves keeps its momentum
    assert whole.model.num_rows == 700
    assert all(torch.isfinite(p).all() for p in whole.model.parameters())


@pytest.mark.pipeline
@pytest.mark.parametrize("stop", [40, 121])
def test_stopped_and_resumed_equals_one_go(scene, whole, tmp_path, stop):
    with pytest.raises(TrainingStopped):
        train(scene, directory=tmp_path, stop_after=stop)
    assert train(scene, directory=tmp_path).model.digest() == whole.model.digest()


@pytest.mark.pipeline
def test_another_seed_is_another_chain(scene, whole):
    assert train(scene, seed=1).model.digest() != whole.model.digest()


def test_the_regularisers_are_the_weighted_means_of_opacity_and_scale(scene):
    stage = method().stages()[0]
    plain = ThreeDGSStage(resolve(ThreeDGS, "paper").config)
    model = method().create_model(scene, stream(0, "init"))
    view, rasterizer = scene.train[0], NegotiatedRasterizer(load_plugins(), device="cpu")
    result = rasterizer.render(model.gaussians(view.camera, rasterizer), view.camera, RasterOptions())
    added = (
        stage.loss(model, view, result, torch.zeros(3), 1).total
        - plain.loss(model, view, result, torch.zeros(3), 1).total
    )
    expected = 0.01 * 0.5 + 0.01 * float(model.scales.mean())
    assert float(added.detach()) == pytest.approx(expected, rel=1e-4)


def test_noise_and_terms_end_where_they_are_told_to(scene):
    short = {"iterations": 300, "scale_schedule": True}
    stage = stage_of(**short, **{"density.settings.noise_stop": 21_000, "density.settings.terms_stop": 24_000})
    pre, _ = build_schedulers(stage, PipelineParams())
    assert {entry.name: entry.when for entry in pre.registrations}["add noise"] == range(210)
    plain = ThreeDGSStage(resolve(ThreeDGS, "paper").config)
    model = method().create_model(scene, stream(0, "init"))
    view, rasterizer = scene.train[0], NegotiatedRasterizer(load_plugins(), device="cpu")
    result = rasterizer.render(model.gaussians(view.camera, rasterizer), view.camera, RasterOptions())
    alone = plain.loss(model, view, result, torch.zeros(3), 1).total
    before, after = (stage.loss(model, view, result, torch.zeros(3), step) for step in (239, 240))
    assert float(before.total.detach()) > float(alone)
    assert set(before.parts) - set(after.parts) == {"opacity", "scale"}
    assert torch.equal(after.total, alone)


def test_the_last_step_and_the_first_are_left_alone(scene):
    made = method()
    stage = made.stages()[0]
    model = made.create_model(scene, stream(0, "init"))
    optimizer = stage.create_optimizer(model, scene)
    with torch.no_grad():
        model.opacity_logits[:20] = math.log(0.001)
    before = model.digest()
    log = TaskLog()
    for step, tasks in ((200, (Relocate(), Grow(), AddNoise())), (1, (AddNoise(),))):
        for task in tasks:
            task(model, optimizer, stage.config, step, *([] if isinstance(task, AddNoise) else [log]))
            assert model.digest() == before
    assert not log.scalars
    for task in (AddNoise(), Relocate(), Grow(cap=900)):
        task(model, optimizer, stage.config, 100, *([] if isinstance(task, AddNoise) else [log]))
        assert model.digest() != before
        before = model.digest()
    assert model.num_rows == 630
    assert {name: value.item() for name, value in log.scalars.items()} == {"relocated": 20, "added": 30}


def test_tasks_are_there_for_other_methods_by_name():
    plugins = load_plugins()
    for name in ("relocate-dead", "grow-to-cap", "add-position-noise"):
        assert plugins.tasks.entry(name).declared["factory"] is True
        assert callable(plugins.tasks.load(name)())
