"""The preset `fast` of 3DGS: its plan, its parts one by one, what it leaves as it was, and that it resumes."""

import pytest
import torch
from sw_gaussians.config import Fast, GaussianTraining
from sw_gaussians.density.budget import BudgetSettings
from sw_gaussians.late_batches import SumViews
from sw_gaussians.resolution import ResolutionSampler
from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.errors import ConfigError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import resolve
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene
from splatwizard_core.scene.scene import Scene
from splatwizard_core.streams import stream
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingRun, TrainingStopped
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from sw_3dgs.method import ThreeDGS
from sw_3dgs.presets import FAST

PLAN = """\
Stage | Task                        | Plan
------+-----------------------------+----------------------
Pre   | update lr                   | range(9000)
Pre   | increase SH degree          | range(0, 9000, 900)
Pre   | average parameters          | range(8100, 9001, 10)
Post  | collect gradient statistics | range(7200)
Post  | densify to budget           | range(270, 7200, 243)
Post  | halve opacity               | range(0, 7200, 1800)"""
STEPS = 60
SHORT = {
    "iterations": STEPS, "density.settings.interval": 5_000, "pictures.schedule": "dash", "lr.opacity": 0.1,
    "density.settings.cap": 1_500, "density.settings.reset_interval": 10_000, "lr.sh_dc": 2e-2,
    "density.settings.score": "opacity_variance", "fast.average": 0.9, "fast.late_views": 3,
}  # fmt: skip
"""Rounds 10 steps apart, the last one at step 42; halvings at 20 and 40; from step 48 on three views make one update,
and the mean is taken of samples at 50 and 60."""


def stage_of(**sets) -> ThreeDGSStage:
    return made_stage("fast", {k.replace("__", "."): v for k, v in sets.items()})


def made_stage(preset: str, sets=None) -> ThreeDGSStage:
    config = resolve(ThreeDGS, preset, sets=sets).config
    plugins = load_plugins()
    return ThreeDGSStage(config, config.density.load(plugins), pictures=config.pictures.load(plugins))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("demo:tiny", SceneOptions(init_points=600), load_plugins())


def train(scene: Scene, *, directory=None, stop_after=None, seed=0, **sets):
    made = ThreeDGS(load_plugins(), resolve(ThreeDGS, "fast", sets={**SHORT, **sets}).config)
    return TrainingRun(
        made.stages(),
        lambda: made.create_model(scene, stream(seed, "init")),
        scene,
        PipelineParams(seed=seed, checkpoint_every=1000),
        NegotiatedRasterizer(load_plugins(), device="cpu"),
        directory=directory,
        identity={},
        trained=lambda name: pytest.fail(f"asked for '{name}'"),
        stop_after=stop_after,
    ).train()


@pytest.fixture(scope="module")
def trained(scene):
    return train(scene)


def test_the_plan_is_three_tenths_of_the_papers():
    assert format_plan(*build_schedulers(stage_of(), PipelineParams())) == PLAN


def test_the_plan_scales_with_the_steps():
    half = format_plan(*build_schedulers(stage_of(iterations=5_000), PipelineParams()))
    assert "range(150, 4000, 135)" in half
    assert "range(0, 4000, 1000)" in half


@pytest.mark.parametrize(
    ("iterations", "final", "sh_rest"),
    [
        (5_000, 1.6e-5, 2.5e-4),
        (12_000, 1.6e-5, 2.5e-4),
        (18_000, 1.6e-6 * 10**0.5, 2.5e-4),
        (24_000, 1.6e-6, 1.25e-4),
        (30_000, 1.6e-6, 1.25e-4),
    ],
)
def test_its_learning_rates_follow_from_the_share_of_the_full_plan(iterations, final, sh_rest):
    lr = stage_of(iterations=iterations).config.lr
    assert (lr.position_final, lr.sh_rest) == (pytest.approx(final, rel=1e-12), sh_rest)


def test_learning_rates_that_are_given_stay_as_those_of_a_file_of_before(tmp_path):
    given = stage_of(iterations=30_000, lr__position_final=1e-5).config.lr
    assert (given.position_final, given.sh_rest) == (1e-5, 1.25e-4)
    (tmp_path / "config.toml").write_text(
        'preset = "fast"\niterations = 30_000\n[lr]\nposition_final = 1.6e-5\nsh_rest = 2.5e-4\n'
    )
    before = resolve(ThreeDGS, config_file=tmp_path / "config.toml").config
    assert (before.lr.position_final, before.lr.sh_rest) == (1.6e-5, 2.5e-4)


def test_learning_rates_do_not_follow_the_length_unless_asked():
    lr = resolve(ThreeDGS, "paper", sets={"iterations": 5_000}).config.lr
    assert (lr.position_final, lr.sh_rest) == (1.6e-6, 1.25e-4)
    asked = resolve(ThreeDGS, "paper", sets={"iterations": 5_000, "fast.rates": "length"})
    assert asked.config.lr.position_final == 1.6e-5
    same = {"iterations": 5_000, "lr.position_final": 1.6e-5, "lr.sh_rest": asked.config.lr.sh_rest}
    assert resolve(ThreeDGS, "paper", sets=same).training_hash() == asked.training_hash()


@pytest.mark.parametrize(
    ("sets", "gone", "come"),
    [
        ({"density": "adc"}, "densify to budget", "prune and densify"),
        ({"density__settings__opacity": "reset"}, "halve opacity", "reset opacity"),
        ({"fast__average": 0}, "average parameters", "densify to budget"),
    ],
)
def test_each_task_can_be_left_out(sets, gone, come):
    plan = format_plan(*build_schedulers(stage_of(**sets), PipelineParams()))
    assert gone not in plan
    assert come in plan


def test_on_a_cpu_pictures_begin_small_and_opacities_are_left_alone(scene):
    stage = made_stage("fast-cpu")
    _, post = build_schedulers(stage, PipelineParams())
    names = {entry.name for step in range(1, stage.iterations + 1) for entry in post.registrations if entry.due(step)}
    assert "densify to budget" in names
    assert not any("opacity" in name for name in names)
    sampler = stage.create_sampler(scene, stream(0, "sampler"))
    assert isinstance(sampler, ResolutionSampler)
    assert sampler.plan.times[-1] <= 0.6 * stage.iterations  # from then on whole pictures, and no new Gaussians


def test_opacity_gradients_are_rendered_until_the_last_densification_and_in_the_last_step():
    stage, black = stage_of(density__settings__score="opacity_variance"), torch.zeros(3)
    asked = [stage.raster_options(step, black).fragment_grad for step in (1, 7_199, 7_200, 8_999, 9_000)]
    assert asked == [True, True, False, False, True]
    assert not stage_of().raster_options(1, black).fragment_grad
    _, post = build_schedulers(stage, PipelineParams())
    assert "collect opacity gradients" in {entry.name for entry in post.registrations}


def test_the_end_has_its_own_tasks_where_it_is_asked_for():
    plan = format_plan(*build_schedulers(stage_of(iterations=10_000, fast__late_views=4), PipelineParams()))
    assert "| average parameters          | range(9000, 10001, 10)" in plan
    assert "| sum views                   | range(8000, 10001)" in plan


def test_late_views_of_an_end_that_does_not_come_are_refused():
    with pytest.raises(ConfigError, match=r"fast\.late_views would have no effect"):
        stage_of(fast__average=0, fast__late_views=8, scale_schedule=False, iterations=7_000)


def test_a_run_that_ends_within_density_control_has_no_average():
    pre, _ = build_schedulers(stage_of(fast__average=0.1, scale_schedule=False, iterations=7_000), PipelineParams())
    assert "average parameters" not in {entry.name for entry in pre.registrations}


def test_an_average_over_few_steps_has_two_samples():
    pre, _ = build_schedulers(stage_of(iterations=10_000, fast__average=0.0005), PipelineParams())
    assert "range(9995, 10001, 5)" in {str(entry.when) for entry in pre.registrations}


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_a_plan_scaled_to_a_few_steps_has_no_end_and_is_not_refused(steps):
    _, post = build_schedulers(stage_of(iterations=steps, fast__late_views=4), PipelineParams())
    (task,) = (entry.task for entry in post.registrations if isinstance(entry.task, SumViews))
    assert task.last == steps - 1


def test_late_sums_end_with_the_last_update():
    _, post = build_schedulers(stage_of(fast__late_views=4), PipelineParams())
    (task,) = (entry.task for entry in post.registrations if isinstance(entry.task, SumViews))
    assert task.last == 8_999  # no update follows the last step


def test_parts_are_off_unless_asked_for(scene):
    assert not isinstance(ThreeDGSStage(GaussianTraining()).create_sampler(scene, stream(0, "s")), ResolutionSampler)
    assert isinstance(stage_of(pictures__schedule="dash").create_sampler(scene, stream(0, "s")), ResolutionSampler)


def test_updates_in_the_backward_pass_can_be_asked_for():
    on = resolve(ThreeDGS, "paper", sets={"fused_updates": True}).config
    assert ThreeDGS(load_plugins(), on).stages()[0].fuses_updates
    usual = resolve(ThreeDGS, "paper").config
    assert usual.fused_updates is None
    assert ThreeDGS(load_plugins(), usual).stages()[0].fuses_updates is None


@pytest.mark.parametrize("sets", [{"density": "mcmc"}, {"fast__late_views": 4}])
def test_what_needs_updates_of_all_gaussians_is_refused_beside_sparse_ones(sets):
    with pytest.raises(ConfigError, match="sparse_adam=true leaves Gaussians"):
        stage_of(sparse_adam=True, fast__average=0.0, **sets)


def test_every_part_is_a_key_of_its_own():
    names = {key.partition(".")[2] for key in FAST if key.startswith("fast.")}
    assert names <= set(Fast.model_fields)
    settings = {f"density.settings.{name}" for name in BudgetSettings.model_fields}
    assert {key for key in FAST if key.startswith("density.")} <= settings


@pytest.mark.pipeline
def test_it_grows_learns_and_leaves_no_buffer_behind(scene, trained):
    model = trained.model
    assert len(scene.points) < model.num_rows <= 1_500
    assert "fragments" not in model.state_dict()
    start = gaussians_from_points(scene.points)
    assert loss(model, scene) < 0.8 * loss(start, scene)


def loss(model, scene) -> float:
    rasterizer, view = NegotiatedRasterizer(load_plugins(), device="cpu"), scene.test[0]
    stage = stage_of()
    with torch.no_grad():
        drawn = rasterizer.render(
            model.gaussians(view.camera, rasterizer), view.camera, stage.raster_options(9_000, None)
        )
        return float((drawn.image - view.image()).square().mean())


@pytest.mark.pipeline
def test_a_training_that_was_stopped_ends_as_one_that_was_not(scene, trained, tmp_path):
    with pytest.raises(TrainingStopped):
        train(scene, directory=tmp_path, stop_after=27)
    resumed = train(scene, directory=tmp_path)
    for name, tensor in trained.model.state_dict().items():
        assert torch.equal(tensor, resumed.model.state_dict()[name]), name
