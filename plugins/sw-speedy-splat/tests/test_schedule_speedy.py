"""The plan is the published one, in its order; every key of 3DGS can be set; what is removed is what the spec says."""

import pytest
import torch
from sw_gaussians.finetune.pruning import removal_count
from sw_gaussians.statistics import collect_statistics

from splatwizard_core.errors import ConfigError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.rasterizer import GradBuffer, RenderResult
from splatwizard_core.runs.config import resolve
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import Protocol, Scene, View
from splatwizard_core.streams import Streams, stream
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from splatwizard_core.training.stage import StageContext
from splatwizard_core.training.state import TrainingState
from sw_speedy_splat.method import SpeedySplat

PAPER_PLAN = """\
Stage | Task                        | Plan
------+-----------------------------+--------------------------
Pre   | update lr                   | range(30000)
Pre   | increase SH degree          | range(0, 30000, 1000)
Post  | collect gradient statistics | range(15000)
Post  | prune and densify           | range(500, 15000, 100)
Post  | soft prune                  | range(6000, 15000, 3000)
Post  | reset opacity               | range(0, 15000, 3000)
Post  | hard prune                  | range(15000, 30000, 3000)"""


def stage_of(preset: str = "paper", rate: str | None = None, plugins=None, **values):
    sets = {key.replace("__", "."): value for key, value in values.items()}
    (stage,) = SpeedySplat(plugins or load_plugins(), resolve(SpeedySplat, preset, rate, sets=sets).config).stages()
    return stage


def plan_of(stage) -> dict[str, str]:
    pre, post = build_schedulers(stage, PipelineParams())
    return {r.name: str(r.when) for r in (*pre.registrations, *post.registrations)}


def test_the_plan_is_the_published_table():
    assert format_plan(*build_schedulers(stage_of(), PipelineParams())) == PAPER_PLAN


def test_removals_fire_at_three_and_five_steps():
    _, post = build_schedulers(stage_of(), PipelineParams())
    fires = {r.name: list(r.fires_in(0, 30_000)) for r in post.registrations}
    assert fires["soft prune"] == [6000, 9000, 12_000]
    assert fires["hard prune"] == [15_000, 18_000, 21_000, 24_000, 27_000]


def test_inria_densifies_from_600_and_nothing_else_changes():
    assert plan_of(stage_of("inria")) == plan_of(stage_of()) | {"prune and densify": "range(600, 15000, 100)"}


@pytest.mark.parametrize("white", [False, True])
def test_resets_come_after_the_soft_removal_also_on_white(white):
    stage = stage_of()
    stage.inner.white = white
    _, post = build_schedulers(stage, PipelineParams())
    names = [r.name for r in post.registrations]
    assert names[:3] == ["collect gradient statistics", "prune and densify", "soft prune"]
    assert all(name.startswith("reset opacity") for name in names[3:-1])
    assert names[-1] == "hard prune"


def test_a_run_that_is_cut_short_removes_nothing_at_its_last_step():
    for last in (9_000, 15_000, 18_000):
        _, post = build_schedulers(stage_of(iterations=last), PipelineParams())
        removals = [r for r in post.registrations if r.name in ("soft prune", "hard prune")]
        assert not any(r.due(last) for r in removals)
        assert any(r.due(last - 3_000) for r in removals)
    assert "soft prune" not in plan_of(stage_of(iterations=6_000))


def test_a_scaled_schedule_scales_the_removals_too():
    stage = stage_of(iterations=3_000, scale_schedule=True)
    plan = plan_of(stage)
    assert plan["soft prune"] == "range(600, 1500, 300)"
    assert plan["hard prune"] == "range(1500, 3000, 300)"
    assert plan["reset opacity"] == "range(0, 1500, 300)"


def test_removals_follow_the_end_of_densification():
    plan = plan_of(stage_of(base__densify__stop=10_000))
    assert plan["soft prune"] == "range(6000, 10000, 3000)"
    assert plan["hard prune"] == "range(12000, 30000, 3000)"
    early = plan_of(stage_of(base__densify__stop=3_000))
    assert "soft prune" not in early
    assert early["hard prune"] == "range(6000, 30000, 3000)"
    assert "hard prune" not in plan_of(stage_of(prune__stop=15_000))
    assert {"soft prune", "hard prune"}.isdisjoint(plan_of(stage_of(prune__soft=0, prune__hard=0)))


@pytest.mark.parametrize("order", [1, -1])
def test_the_density_control_of_3dgs_can_be_chosen_and_set(order):
    sets = [("base.density", "mcmc"), ("base.density.settings.cap", "700")][::order]
    (stage,) = SpeedySplat(load_plugins(), resolve(SpeedySplat, "paper", sets=dict(sets)).config).stages()
    assert (stage.densify_stop, stage.inner.control.settings.cap) == (25_000, 700)
    assert "relocate" in plan_of(stage)


def test_every_key_of_3dgs_can_be_set_and_a_wrong_one_is_told():
    stage = stage_of(base__densify__interval="50", base__lr__opacity="0.025", base__sh_degree="1")
    assert plan_of(stage)["prune and densify"] == "range(500, 15000, 50)"
    assert (stage.inner.config.lr.opacity, stage.inner.config.sh_degree) == (0.025, 1)
    with pytest.raises(ConfigError, match=r"unknown key 'densify\.strat' in config of '3dgs'"):
        stage_of(base__densify__strat=3)
    with pytest.raises(ConfigError, match="preset"):
        stage_of(base__preset="fastest")


@pytest.mark.parametrize("name", [*SpeedySplat.PRESETS])
@pytest.mark.parametrize("rate", [*SpeedySplat.RATES])
def test_every_preset_makes_a_plan_at_every_rate_point(name, rate):
    plan = plan_of(stage_of(name, rate))
    assert {"soft prune", "hard prune"} <= set(plan)


def test_rate_points_remove_less_and_less():
    points = [(v["prune.soft"], v["prune.hard"]) for v in SpeedySplat.RATES.values()]
    assert points == sorted(points, reverse=True)
    assert points[2] == (0.80, 0.30) == tuple(SpeedySplat.RATES[SpeedySplat.DEFAULT_RATE].values())


def test_an_unknown_pruner_or_codec_is_told_with_those_there_are():
    with pytest.raises(ConfigError, match="speedy-splat"):
        stage_of(prune__pruner="speedy")
    with pytest.raises(ConfigError, match="gaussians-exact"):
        stage_of(codec="range")


class FakeStatistics:
    uses_statistics = True

    def score(self, model, cameras, rasterizer, background=None):
        if not bool((model.grad_accum != 0).any()):
            raise ValueError("all statistics are equal")
        return model.grad_accum


def with_pruner(monkeypatch, cls):
    plugins = load_plugins()
    found = plugins.pruners.load
    monkeypatch.setattr(plugins.pruners, "load", lambda name: cls if name == "opacity" else found(name))
    return plugins


def test_a_pruner_of_statistics_comes_before_the_densification_and_has_them_collected(monkeypatch):
    stage = stage_of(plugins=with_pruner(monkeypatch, FakeStatistics), prune__pruner="opacity")
    _, post = build_schedulers(stage, PipelineParams())
    names = [r.name for r in post.registrations]
    assert names.index("collect gradient statistics") < names.index("soft prune") < names.index("prune and densify")
    window = next(r for r in post.registrations if r.name == "collect statistics for the pruner")
    assert str(window.when) == "range(15000, 27001)"
    assert names.index("collect statistics for the pruner") < names.index("hard prune")


def test_statistics_are_taken_as_3dgs_asks_for_them():
    model = splats(4)
    result = RenderResult(torch.zeros(3, 2, 2), torch.ones(4, dtype=torch.int32), None)
    with pytest.raises(ValueError, match="density control asks for them"):
        collect_statistics(model, result)
    result.absgrad2d = GradBuffer()
    result.absgrad2d.set(torch.full((4, 2), 3.0))
    collect_statistics(model, result)
    assert bool((model.grad_accum > 0).all())


def splats(n: int, seed: int = 0) -> GaussianModel:
    g = torch.Generator().manual_seed(seed)
    return GaussianModel(
        torch.rand(n, 3, generator=g) - 0.5, torch.rand(n, 1, 3, generator=g), torch.zeros(n, 15, 3),
        torch.rand(n, generator=g), torch.full((n, 3), -3.0), torch.rand(n, 4, generator=g),
    )  # fmt: skip


def scene_of(n: int = 3) -> Scene:
    up, target = torch.tensor([0.0, 1.0, 0.0]), torch.zeros(3)
    eyes = torch.tensor([[0.0, 0, -4], [3.0, 0, -3], [-3.0, 1, -3]])[:n]
    views = [
        View(Camera.look_at(e, target, up, width=16, height=16, fov_x=0.6), f"{i}.png") for i, e in enumerate(eyes)
    ]
    return Scene("tiny", views, views[:1], None, Protocol("test"))


class Ranks:
    """Scores by row, and notes when it was asked."""

    uses_statistics = False
    asked: list[int]

    def score(self, model, cameras, rasterizer, background=None):
        type(self).asked.append(model.num_rows)
        return torch.arange(model.num_rows).float()


@pytest.fixture
def counted(monkeypatch):
    Ranks.asked = []
    stage = stage_of(plugins=with_pruner(monkeypatch, Ranks), prune__pruner="opacity")
    model, scene = splats(1000), scene_of()
    context = StageContext(model, scene, PipelineParams(), None, lambda name: stream(0, name), lambda name: None)
    model = stage.begin(context)
    state = TrainingState.begin(stage, model, scene, PipelineParams(), NoRasterizer(), Streams(0))
    return state.post, state


class NoRasterizer:
    info = None

    def render(self, g, cam, opt):
        raise AssertionError

    def visible_filter(self, g, cam):
        raise AssertionError

    def accumulate(self, g, cams, opt):
        raise AssertionError


def with_result(task):
    model = task.model
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    task.result = RenderResult(torch.zeros(3, 16, 16), torch.ones(model.num_rows, dtype=torch.int32), None)
    task.result.grad2d = GradBuffer()
    task.result.grad2d.set(torch.zeros(model.num_rows, 2))
    return task


def test_at_6000_the_soft_removal_sees_the_opacities_before_the_reset(counted):
    post, task = counted
    seen = {}

    class Opacities(Ranks):
        def score(self, model, cameras, rasterizer, background=None):
            seen["max"] = float(model.opacities.max())
            return super().score(model, cameras, rasterizer)

    next(r for r in post.registrations if r.name == "soft prune").task.pruner = Opacities()
    Opacities.asked = []
    with torch.no_grad():
        post.exec(6000, with_result(task))
    assert seen["max"] > 0.5
    assert float(task.model.opacities.detach().max()) == pytest.approx(0.01, rel=1e-4)
    assert task.model.num_rows == 1000 - removal_count(1000, 0.8) == 200


def test_five_hard_removals_leave_169_of_a_thousand_and_survivors_are_still_updated(counted):
    post, task = counted
    left = []
    for step in (15_000, 18_000, 21_000, 24_000, 27_000):
        before = task.model.means.detach()[-1].clone()
        with torch.no_grad():
            post.exec(step, with_result(task))
        left.append(task.model.num_rows)
        assert task.model.means.grad is not None  # carried
        assert torch.equal(task.model.means.detach()[-1], before)  # the highest rank stays, and in order
    assert left == [700, 490, 343, 241, 169]


def test_a_soft_removal_leaves_no_gradient(counted):
    post, task = counted
    with torch.no_grad():
        post.exec(9000, with_result(task))
    assert all(parameter.grad is None for parameter in task.model.parameters())


def test_the_fast_preset_of_3dgs_keeps_the_order_of_removals():
    _, post = build_schedulers(stage_of(base__preset="fast"), PipelineParams())
    names = [r.name for r in post.registrations]
    assert names[-4:] == ["densify to budget", "soft prune", "halve opacity", "hard prune"]
