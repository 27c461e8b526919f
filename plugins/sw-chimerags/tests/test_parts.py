"""Every part can be another's, by name and without code; and all of it together learns, resumes and decodes."""

import importlib.metadata
import sys
from pathlib import Path

import pytest
import torch
from sw_gaussians.start import gaussians_from_points
from sw_kit.short_training import train as train_method

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import ConfigError
from splatwizard_core.plugins.manager import PluginManager
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import resolve
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingStopped
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from sw_chimerags.method import ChimeraGS

DISTILL_PLAN = """\
Stage | Task                       | Plan
------+----------------------------+-----
Post  | calculate importance score | 5000"""


@pytest.fixture(scope="module")
def everybody():
    """All installed plugins, and the stranger's."""
    sys.path.insert(0, str(Path(__file__).parent))
    found = list(importlib.metadata.entry_points(group="splatwizard"))
    yield PluginManager([*found, importlib.metadata.EntryPoint("theirs", "their_parts", "splatwizard")])
    sys.path.remove(str(Path(__file__).parent))


@pytest.fixture(scope="module")
def scene(everybody):
    return load_scene("demo:tiny", SceneOptions(init_points=500), everybody)


def method_of(plugins, preset="paper", rate=None, **sets) -> ChimeraGS:
    values = {key.replace("__", "."): value for key, value in sets.items()}
    return ChimeraGS(plugins, resolve(ChimeraGS, preset, rate, sets=values, plugins=plugins).config)


def test_the_plan_is_speedy_splats_and_the_published_one(everybody):
    stages = method_of(everybody).stages()
    assert [(stage.name, stage.iterations) for stage in stages] == [("speedy-splat", 30_000), ("distill", 5_000)]
    plans = [build_schedulers(stage, PipelineParams()) for stage in stages]
    assert {r.name: str(r.when) for r in plans[0][1].registrations} == {
        "collect gradient statistics": "range(0, 15000)",
        "prune and densify": "range(500, 15000, 100)",
        "soft prune": "range(6000, 15000, 3000)",
        "reset opacity": "range(0, 15000, 3000)",
        "hard prune": "range(15000, 30000, 3000)",
    }
    assert format_plan(*plans[1]) == DISTILL_PLAN
    assert stages[1].taught_by == ("3dgs",)


def test_a_scaled_schedule_scales_both_stages(everybody):
    stages = method_of(everybody, iterations=3_000, scale_schedule=True).stages()
    assert [stage.iterations for stage in stages] == [3_000, 500]
    _, post = build_schedulers(stages[1], PipelineParams())
    assert [r.when for r in post.registrations] == [500]


def test_a_run_that_is_cut_short_has_no_longer_stage(everybody):
    assert [stage.iterations for stage in method_of(everybody, "quick", iterations=20).stages()] == [20, 20]


def test_rates_that_change_are_a_task_of_the_plan(everybody):
    stage = method_of(everybody, distill__lr__decay=0.9).stages()[-1]
    pre, _ = build_schedulers(stage, PipelineParams())
    assert [(r.name, str(r.when)) for r in pre.registrations] == [("update lr", "range(0, 5000)")]


def test_keys_reach_the_student_and_what_it_borrows(everybody):
    first, _ = method_of(everybody, student__base__densify__interval="50", student__prune__start="3000").stages()
    plan = {r.name: str(r.when) for r in build_schedulers(first, PipelineParams())[1].registrations}
    assert plan["prune and densify"] == "range(500, 15000, 50)"
    assert plan["soft prune"] == "range(3000, 15000, 3000)"
    with pytest.raises(ConfigError, match="prune"):
        method_of(everybody, student__prune__sotf=0.5).stages()


@pytest.mark.parametrize("preset", [*ChimeraGS.PRESETS])
@pytest.mark.parametrize("rate", [*ChimeraGS.RATES])
def test_every_preset_makes_its_stages_at_every_rate_point(everybody, preset, rate):
    first, second = method_of(everybody, preset, rate).stages()
    assert first.config.prune.stop <= first.iterations
    values = ChimeraGS.RATES[rate]
    assert (first.config.prune.soft, first.config.prune.hard) == (values["train.soft"], values["train.hard"])
    assert second.config.mask.weight == values["mask.weight"]


@pytest.mark.parametrize("preset", ["paper", "quick"])
@pytest.mark.parametrize("name", ["3dgs", "lightgaussian", "trimming-the-fat"])
def test_other_methods_of_explicit_gaussians_may_make_the_student(everybody, preset, name):
    if name not in everybody.methods:
        pytest.skip(f"{name} is not installed")
    stages = method_of(everybody, preset, train__method=name).stages()
    assert len(stages) >= 2
    assert stages[-1].name == "distill"


def test_rate_points_remove_less_and_less():
    points = [(v["train.soft"], v["train.hard"], v["mask.weight"]) for v in ChimeraGS.RATES.values()]
    assert points == sorted(points, reverse=True)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("score__pruner", "no-such"),
        ("codec", "range"),
        ("train__method", "chimerags"),
        ("score__pruner", "trimming-the-fat"),
    ],
)
def test_parts_that_cannot_serve_are_told_in_a_line(everybody, key, value):
    if value not in everybody.pruners and value == "trimming-the-fat":
        pytest.skip("sw-trimming-the-fat is not installed")
    with pytest.raises(ConfigError) as told:
        method_of(everybody, **{key: value}).stages()
    assert "\n" not in str(told.value)


@pytest.mark.pipeline
def test_student_teacher_score_and_coder_of_others_need_names_alone(everybody, scene):
    """--set train.method=theirs --set distill.teacher=theirs --set score.pruner=their-order --set codec=..."""
    method = method_of(
        everybody, "quick", train__method="theirs", student__nudge="-0.5", student__preset="paper",
        distill__teacher="theirs", distill__iterations="4", score__pruner="their-order", codec="their-vectors",
        mask__weight="100", distill__pseudo_views="false", steps__colors="0", xyz="float32",
    )  # fmt: skip
    first, second = method.stages()
    assert (first.name, first.iterations, first.opt.nudge, second.taught_by) == ("theirs", 5, -0.5, ("theirs",))
    asked = []

    def trained(name):
        asked.append(name)
        return gaussians_from_points(scene.points).requires_grad_(False)

    rasterizer = NegotiatedRasterizer(everybody, device="cpu")
    model = train_method(method, scene, rasterizer, stages=[first, second], trained=trained).model
    assert asked == ["theirs"]
    assert torch.equal(model.importance, torch.arange(model.num_rows).float())
    writer = ContainerWriter("chimerags", 1)
    method.encode(model, writer)
    reader = ContainerReader(writer.to_bytes(), "file.swz")
    assert {"sh2/vq/all", "sh2/vq/most"} <= set(reader.sections)
    found = ChimeraGS(everybody, None).decode(reader)
    order = [torch.argsort(m.means[:, 0].detach(), stable=True) for m in (model, found)]
    assert torch.equal(model.sh_dc[order[0]], found.sh_dc[order[1]])  # float32, as their coder has it


SHORT = {
    "iterations": 60, "student.prune.start": 20, "student.prune.interval": 20, "student.prune.stop": 55,
    "student.base.densify.start": 10, "student.base.densify.interval": 10, "student.base.densify.stop": 40,
    "train.soft": 0.2, "distill.iterations": 20, "codec.settings.iterations": 5,
}  # fmt: skip


def run(plugins, scene, directory=None, stop_after=None):
    method = ChimeraGS(plugins, resolve(ChimeraGS, "quick", sets=SHORT, plugins=plugins).config)
    teacher = gaussians_from_points(scene.points).requires_grad_(False)
    model = train_method(
        method, scene, NegotiatedRasterizer(plugins, device="cpu"), trained=lambda name: teacher, directory=directory,
        stop_after=stop_after,
    ).model  # fmt: skip
    return method, model


@pytest.mark.pipeline
def test_a_run_that_is_stopped_in_the_distillation_ends_in_the_same_file(everybody, scene, tmp_path):
    method, whole = run(everybody, scene)
    with pytest.raises(TrainingStopped):
        run(everybody, scene, tmp_path, stop_after=70)
    _, resumed = run(everybody, scene, tmp_path)
    _, loaded = run(everybody, scene, tmp_path)  # finished: only read
    assert resumed.digest() == whole.digest() == loaded.digest()
    assert loaded.has_importance()
    writer = ContainerWriter("chimerags", 1)
    method.encode(loaded, writer)
    assert ChimeraGS(everybody, None).decode(ContainerReader(writer.to_bytes())).num_rows == whole.num_rows


def test_a_model_without_importance_gets_it_at_the_end(everybody, scene):
    stage = method_of(everybody, score__pruner="their-order", distill__iterations=1).stages()[-1]
    teacher = gaussians_from_points(scene.points).requires_grad_(False)
    stage._rasterizer = NegotiatedRasterizer(everybody, device="cpu")
    from sw_chimerags.model import MaskedGaussians

    model = MaskedGaussians.of(teacher, quantizer=stage.quantizer, init=-4.5951)
    assert not model.has_importance()
    assert stage.finish(model, scene).has_importance()
