"""The plan of 3DGS is the published one, line by line."""

from types import SimpleNamespace

import pytest
import torch
from sw_gaussians.ply import export_ply
from sw_gaussians.stage import ThreeDGSStage, UpdateLearningRate
from sw_gaussians.start import gaussians_from_points
from sw_gaussians.tasks import PruneAndDensify, ResetOpacity

from splatwizard_core.errors import ConfigError, SceneError, UserInputError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import apply_overrides, resolve
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.streams import stream
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from splatwizard_core.training.stage import CameraIterator
from splatwizard_core.training.task_log import TaskLog
from splatwizard_core.training.tasks import TaskContext
from sw_3dgs.config import ThreeDGSConfig
from sw_3dgs.method import ThreeDGS

PAPER_PLAN = """\
Stage | Task                        | Plan
------+-----------------------------+-----------------------
Pre   | update lr                   | range(30000)
Pre   | increase SH degree          | range(0, 30000, 1000)
Post  | collect gradient statistics | range(15000)
Post  | prune and densify           | range(500, 15000, 100)
Post  | reset opacity               | range(0, 15000, 3000)"""


def stage_of(preset: str = "paper", **values) -> ThreeDGSStage:
    config = apply_overrides(ThreeDGSConfig(), {k.replace("__", "."): v for k, v in values.items()}, source="test")
    if preset != "paper":
        config = resolve(ThreeDGS, preset, sets={k.replace("__", "."): v for k, v in values.items()}).config
    return ThreeDGSStage(config, config.density.load(load_plugins()))


def plan_of(stage: ThreeDGSStage) -> dict[str, str]:
    pre, post = build_schedulers(stage, PipelineParams())
    return {r.name: str(r.when) for r in (*pre.registrations, *post.registrations)}


def tiny_scene(background: str = "black", points: PointCloud | None = None) -> Scene:
    up, target = torch.tensor([0.0, 1.0, 0.0]), torch.zeros(3)
    eyes = torch.tensor([[0.0, 0, -4], [3.0, 0, -3], [-3.0, 1, -3]])
    views = [
        View(Camera.look_at(e, target, up, width=16, height=16, fov_x=1.0), f"{i}.png") for i, e in enumerate(eyes)
    ]
    return Scene("tiny", views, views[:1], points, Protocol("test", background=background))


def begin(stage: ThreeDGSStage, scene: Scene, model: GaussianModel | None = None) -> GaussianModel:
    model = model or gaussians_from_points(PointCloud(torch.rand(8, 3), torch.rand(8, 3)))
    context = SimpleNamespace(model=model, scene=scene, ppl=PipelineParams(), generator=lambda name: stream(3, name))
    return stage.begin(context)


def test_the_plan_is_the_papers_table():
    pre, post = build_schedulers(stage_of(), PipelineParams())
    assert format_plan(pre, post) == PAPER_PLAN


@pytest.mark.parametrize("preset", ["inria", "inria2024"])
def test_the_authors_code_densifies_from_600(preset):
    assert plan_of(stage_of(preset))["prune and densify"] == "range(600, 15000, 100)"


def test_presets_set_what_the_table_of_differences_says():
    recent = resolve(ThreeDGS, "inria2024")
    assert recent.config.lr.opacity == 0.025
    assert recent.ppl.clamp_render
    assert resolve(ThreeDGS, "inria").config.lr.opacity == 0.05
    assert not resolve(ThreeDGS, "inria").ppl.clamp_render
    absgrad = resolve(ThreeDGS, "absgrad").config.density.settings
    assert (absgrad["absgrad"], absgrad["grad_threshold"]) == (True, 8e-4)


@pytest.mark.parametrize("name", [*ThreeDGS.PRESETS])
@pytest.mark.parametrize("rate", [*ThreeDGS.RATES])
def test_every_preset_resolves_at_every_rate_point(name, rate):
    assert resolve(ThreeDGS, name, rate).config.codec.name in ("gaussians-exact", "gaussians-quantized")


def test_no_reset_comes_after_the_end_of_densification_on_white_either():
    for stop, resets in ((15_000, True), (400, False)):
        stage = stage_of(density__settings__stop=stop)
        begin(stage, tiny_scene("white"))
        assert ("reset opacity (white background)" in plan_of(stage)) == resets


def test_fewer_iterations_alone_keep_the_plan():
    assert plan_of(stage_of(iterations=7000)) == plan_of(stage_of())


def test_a_scaled_schedule_scales_bounds_intervals_and_the_rules_inside_tasks():
    stage = stage_of(iterations=3000, scale_schedule=True)
    assert plan_of(stage) == {
        "update lr": "range(0, 3000)",
        "increase SH degree": "range(0, 3000, 100)",
        "collect gradient statistics": "range(0, 1500)",
        "prune and densify": "range(50, 1500, 10)",
        "reset opacity": "range(0, 1500, 300)",
    }
    pre, post = build_schedulers(stage, PipelineParams())
    tasks = {r.name: r.task for r in (*pre.registrations, *post.registrations)}
    assert tasks["update lr"].max_steps == 3000
    assert (
        stage.control.steps(stage.control.settings.reset_interval) == 300
    )  # until then nothing is pruned for its size


def test_a_white_scene_gets_one_more_reset_between_densification_and_the_periodic_one():
    stage = stage_of()
    begin(stage, tiny_scene("white"))
    _, post = build_schedulers(stage, PipelineParams())
    assert [(r.name, str(r.when)) for r in post.registrations] == [
        ("collect gradient statistics", "range(0, 15000)"),
        ("prune and densify", "range(500, 15000, 100)"),
        ("reset opacity (white background)", "500"),
        ("reset opacity", "range(0, 15000, 3000)"),
    ]
    black = stage_of()
    begin(black, tiny_scene("black"))
    assert len(plan_of(black)) == 5


def test_learning_rate_of_the_means_is_the_published_one():
    task = UpdateLearningRate()
    extent = 4.8
    assert task.rate(0, extent) == pytest.approx(1.6e-4 * extent, rel=1e-6)
    assert task.rate(15_000, extent) == pytest.approx(1.6e-5 * extent, rel=1e-6)
    assert task.rate(30_000, extent) == pytest.approx(1.6e-6 * extent, rel=1e-6)
    assert task.rate(40_000, extent) == task.rate(30_000, extent)
    assert task.rate(-1, extent) == 0


def test_the_delay_multiplier_needs_delay_steps():
    assert UpdateLearningRate(delay_mult=0.01).rate(0, 1.0) == pytest.approx(1.6e-4)
    assert UpdateLearningRate(delay_mult=0.01, delay_steps=100).rate(0, 1.0) == pytest.approx(1.6e-6)
    assert UpdateLearningRate(delay_mult=0.01, delay_steps=100).rate(100, 1.0) == pytest.approx(
        UpdateLearningRate().rate(100, 1.0)
    )


def test_pre_tasks_raise_the_sh_degree_and_set_the_rate_at_the_published_steps():
    stage, scene = stage_of(), tiny_scene()
    model = begin(stage, scene)
    optimizer = stage.create_optimizer(model, scene)
    pre, _ = build_schedulers(stage, PipelineParams())
    context = TaskContext(PipelineParams(), stage.opt, model, scene, optimizer, CameraIterator(scene.train), None)
    degrees, rates = {}, {}
    for step in range(1, 3002):
        pre.exec(step, context)
        degrees[step], rates[step] = model.active_sh_degree, optimizer.lr("means")
    assert [degrees[s] for s in (1, 999, 1000, 1999, 2000, 2999, 3000, 3001)] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert rates[3000] == pytest.approx(scene.extent * 1.6e-4 * 10 ** (-2 * 0.1), rel=1e-6)


def test_groups_and_their_rates():
    stage, scene = stage_of(), tiny_scene()
    optimizer = stage.create_optimizer(begin(stage, scene), scene)
    rates = {name: group.lr for name, group in optimizer.groups.items()}
    assert list(rates) == ["means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats"]
    assert rates["means"] == pytest.approx(1.6e-4 * scene.extent)
    assert [rates[n] for n in list(rates)[1:]] == [2.5e-3, 1.25e-4, 0.05, 5e-3, 1e-3]
    assert all((g.eps, g.betas) == (1e-15, (0.9, 0.999)) for g in optimizer.groups.values())


def test_the_last_step_neither_densifies_nor_resets():
    """No update follows that could repair the picture."""
    scene = tiny_scene()
    model = begin(stage_of(), scene)
    optimizer = ThreeDGSStage(ThreeDGSConfig()).create_optimizer(model, scene)
    before = model.opacity_logits.detach().clone()
    for step, runs in ((6000, False), (3000, True)):
        model.denom.fill_(1.0)
        PruneAndDensify()(model, optimizer, scene, ThreeDGSConfig(iterations=6000), step, TaskLog())
        assert (not model.denom.any()) is runs, step
        ResetOpacity(ceiling=0.001)(model, optimizer, ThreeDGSConfig(iterations=6000), step)
        assert (not torch.equal(model.opacity_logits[:1], before[:1])) is runs, step


def test_absgrad_asks_the_rasterizer_for_absolute_gradients_only():
    options = stage_of("absgrad").raster_options(1, torch.zeros(3))
    assert (options.absgrad, options.grad2d) == (True, False)
    options = stage_of().raster_options(1, torch.zeros(3))
    assert (options.absgrad, options.grad2d) == (False, True)
    assert plan_of(stage_of("absgrad"))["collect gradient statistics"] == "range(0, 15000)"


def test_splits_follow_the_run_seed():
    stage = stage_of()
    assert begin(stage, tiny_scene()).split_seed == stream(3, "split").initial_seed()


def test_tasks_are_there_for_other_methods_by_name():
    plugins = load_plugins()
    for name in ("update-lr", "prune-and-densify", "reset-opacity"):
        assert plugins.tasks.entry(name).declared["factory"] is True
        assert callable(plugins.tasks.load(name)())
    for name in ("increase-sh-degree", "collect-gradient-statistics", "collect-absgrad-statistics"):
        assert plugins.tasks.entry(name).declared["factory"] is False
        assert callable(plugins.tasks.load(name))


def create(scene: Scene, **values) -> GaussianModel:
    config = apply_overrides(ThreeDGSConfig(), values, source="test")
    return ThreeDGS(load_plugins(), config).create_model(scene, stream(0, "init"))


def test_the_model_starts_from_the_points_of_the_scene():
    points = PointCloud(torch.rand(20, 3), torch.rand(20, 3))
    model = create(tiny_scene(points=points), sh_degree=2)
    assert torch.equal(model.means, points.xyz)
    assert (model.max_sh_degree, model.active_sh_degree) == (2, 0)


def test_a_scene_without_points_is_refused():
    with pytest.raises(SceneError, match="no start points"):
        create(tiny_scene())


def test_a_ply_is_a_start_with_all_bands_active(tmp_path):
    trained = gaussians_from_points(PointCloud(torch.rand(20, 3), torch.rand(20, 3)))
    export_ply(trained, tmp_path / "m.ply")
    model = create(tiny_scene(), init=str(tmp_path / "m.ply"))
    assert model.active_sh_degree == 3
    assert torch.equal(model.means, trained.means)


def test_a_start_from_surfels_is_refused(tmp_path):
    trained = gaussians_from_points(PointCloud(torch.rand(5, 3), None))
    export_ply(trained, tmp_path / "m.ply")
    flat = (tmp_path / "m.ply").read_bytes().replace(b"float scale_2", b"float other_2")
    (tmp_path / "m.ply").write_bytes(flat)
    with pytest.raises(UserInputError, match="these are surfels"):
        create(tiny_scene(), init=str(tmp_path / "m.ply"))


@pytest.mark.parametrize(("key", "value"), [("mcmc.enabled", "maybe"), ("fast.densify", "bogus")])
def test_an_older_switch_takes_its_values_alone(key, value):
    plugins = load_plugins()
    with pytest.raises(ConfigError, match=f"bad value '{value}' for '{key}'"):
        resolve(plugins.methods.load("3dgs"), "paper", sets={key: value}, plugins=plugins)
