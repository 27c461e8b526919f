"""Several views in an update, and several processes that draw them: equal bits in all, and what one process makes."""

import functools
import io
import json
import multiprocessing
import os
import subprocess
import sys
import threading
from types import SimpleNamespace

import pytest
import torch
from forked_children import start_python
from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.wrapped_stage import WrappedStage
from sw_parallel import followers
from sw_parallel.followers import Job, followed, wait_for
from sw_parallel.ranks import Ranks

from splatwizard_core.errors import CapabilityError, ConfigError, SplatwizardError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import resolve
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene
from splatwizard_core.streams import Streams
from splatwizard_core.training.identity import given_values
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingRun
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from splatwizard_core.training.stage import PlannedTask, StageContext
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.trainer import Trainer
from sw_3dgs.method import ThreeDGS
from sw_3dgs.shared_stage import SharedStage, shared_stage

STEPS = 20
PLAN = {
    "density.settings.start": 16, "density.settings.interval": 16, "density.settings.grad_threshold": 5e-5,
    "density.settings.reset_interval": 24,
}  # fmt: skip
TRAIN = """
import functools, hashlib, json, sys
from pathlib import Path
import torch
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import resolve
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene
from splatwizard_core.streams import Streams
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingRun
from splatwizard_core.training.stage import StageContext
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.trainer import Trainer
from sw_3dgs.method import ThreeDGS
from sw_3dgs.shared_stage import shared_stage
from sw_parallel.ranks import Ranks, joined

sets, rank, count, steps, device, out = json.loads(sys.argv[1])
torch.set_num_threads(1)
if device == "cuda":
    torch.cuda.set_device(rank)
plugins = load_plugins()
config = resolve(ThreeDGS, "paper", sets=sets, plugins=plugins).config
scene = load_scene("demo:tiny", SceneOptions(init_points=600), plugins)
ranks, ppl, streams = Ranks(rank, count), PipelineParams(), Streams(0)
stage = shared_stage(config, plugins, ranks)
rasterizer = NegotiatedRasterizer(plugins, device=device)
model = ThreeDGS(plugins, config).create_model(scene, streams("init")).to(device)
model = stage.begin(StageContext(model, scene, ppl, rasterizer, streams, None))
trainer = Trainer(TrainingState.begin(stage, model, scene, ppl, rasterizer, streams))
digests, views = [], []

def look(state):
    moments = [t for each in state.optimizer.states.values() for t in each.tensors.values()]
    tensors = [*state.model.parameters(), *moments, state.sampler.generator.get_state()]
    digests.append(hashlib.sha256(b"".join(t.detach().cpu().numpy().tobytes() for t in tensors)).hexdigest())
    views.append(state.view)

def go():
    trainer.run(steps, look)
    torch.save(dict(trainer.state.model.state_dict()), out + f"/{rank}.pt")
    print(json.dumps({"digests": digests, "views": views, "rows": trainer.state.num_rows}))

if count > 1:
    with joined(ranks, torch.device(device), Path(out, "meeting")):
        go()
else:
    go()
"""


def train(folder, *, count: int, steps: int, device: str = "cpu", **sets):
    """Train in `count` processes that were forked; what each printed, and the model of each."""
    folder.mkdir()
    given = [json.dumps([sets, rank, count, steps, device, str(folder)]) for rank in range(count)]
    children = [start_python("-c", TRAIN, each, stdout=subprocess.PIPE, text=True) for each in given]
    told = [json.loads(child.communicate(timeout=300)[0]) for child in children]
    return told, [torch.load(folder / f"{rank}.pt", map_location="cpu", weights_only=True) for rank in range(count)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("shared")


@pytest.fixture(scope="module")
def scene():
    return load_scene("demo:tiny", SceneOptions(init_points=300), load_plugins())


on_two_gpus = pytest.param(
    "cuda", marks=[pytest.mark.cuda, pytest.mark.skipif(torch.cuda.device_count() < 2, reason="no two GPUs")]
)


@pytest.mark.parametrize("device", ["cpu", on_two_gpus])
def test_processes_stay_equal_in_every_bit_through_densification_and_reset(folder, device):
    sets = {"gpus": 2, "batch": 2, "iterations": 400, **PLAN}
    (first, second), models = train(folder / f"equal-{device}", count=2, steps=STEPS, device=device, **sets)
    assert first["digests"] == second["digests"]
    assert len(set(first["digests"])) == STEPS
    assert not set(first["views"][:3]) & set(second["views"][:3])  # one draw of all views goes to both
    assert first["rows"] > 600
    for name in dict(models[0]).keys() - {"grad_accum", "denom", "max_radii2d"}:  # added up where they are looked at
        assert torch.equal(models[0][name], models[1][name]), name


def test_they_make_what_one_process_makes_of_both_views(folder):
    calm = {"iterations": 400, "density.settings.start": 300, "batch": 4}
    (told,), (one,) = train(folder / "one", count=1, steps=STEPS, **calm)
    (first, second), (two, _) = train(folder / "two", count=2, steps=STEPS // 2, gpus=2, **calm)
    assert told["views"] == [view for both in zip(first["views"], second["views"], strict=True) for view in both]
    # Four gradients are summed in another order, and of what is but rounding Adam makes a step as of anything: turning
    # a sphere changes nothing, so rotations are left out, and of the rest a hundredth may differ.
    for name in ("means", "sh_dc", "opacity_logits", "log_scales"):
        alike = torch.isclose(one[name], two[name], atol=1e-4, rtol=1e-4)
        assert float(alike.float().mean()) > 0.99, name


def config_of(**sets):
    return resolve(
        ThreeDGS, "paper", sets={k.replace("__", "."): v for k, v in sets.items()}, plugins=load_plugins()
    ).config


def stage_of(**sets) -> ThreeDGSStage:
    return ThreeDGS(load_plugins(), config_of(**sets)).stages()[0]


def test_plan_and_steps_are_counted_in_views():
    stage = stage_of(gpus=2)
    assert (stage.iterations, stage.batch, stage.settled) == (15_000, 4, 7_500)
    plan = format_plan(*build_schedulers(stage, PipelineParams()), total=stage.iterations)
    assert "prune and densify           | range(250, 7500, 50)" in plan
    assert "sum views                   | range(15001)" in plan
    assert stage_of(gpus=2, iterations=7_001, batch=2).iterations == 3_501
    assert isinstance(stage_of(), ThreeDGSStage)
    assert not isinstance(stage_of(), SharedStage)


def test_rates_and_moments_follow_the_batch(scene):
    plain, shared = stage_of(), stage_of(batch=4)
    model = ThreeDGS(load_plugins(), config_of()).create_model(scene, torch.Generator())
    one, four = (stage.create_optimizer(model, scene) for stage in (plain, shared))
    for name, group in four.groups.items():
        assert group.lr == pytest.approx(2 * one.groups[name].lr)
        assert group.betas == pytest.approx((0.9**4, 0.999**4))


def test_a_batch_that_gpus_cannot_share_is_refused_and_so_is_what_needs_one_view():
    for sets, named in (
        ({"gpus": 2, "batch": 3}, "batch of 3"),
        ({"batch": 2, "sparse_adam": True}, "sparse_adam"),
        ({"batch": 2, "fused_updates": True}, "fused_updates"),
        ({"batch": 2, "fast.late_views": 2}, "late_views"),
    ):
        with pytest.raises(ConfigError, match=named):
            stage_of(**sets)


def test_a_batch_is_part_of_what_makes_a_training_and_the_number_of_gpus_is_not():
    plugins = load_plugins()
    told = [
        given_values(config_of(**sets), plugins) for sets in ({}, {"gpus": 2}, {"batch": 4}, {"gpus": 4, "batch": 4})
    ]
    assert told[1] == told[2] == told[3] == {**told[0], "batch": 4}


def test_a_job_goes_on_with_the_very_next_step(scene):
    plugins, config, ppl, streams = load_plugins(), config_of(batch=2, iterations=400), PipelineParams(), Streams(0)
    rasterizer, stage = NegotiatedRasterizer(plugins, device="cpu"), shared_stage(config, plugins)
    model = ThreeDGS(plugins, config).create_model(scene, streams("init"))
    model = stage.begin(StageContext(model, scene, ppl, rasterizer, streams, pytest.fail))
    state = TrainingState.begin(stage, model, scene, ppl, rasterizer, streams)
    Trainer(state).run(3, lambda _: None)
    file = io.BytesIO()
    torch.save(Job.of(state, functools.partial(shared_stage, config)), file)
    file.seek(0)
    other = torch.load(file, weights_only=False).begin(Ranks()).state
    assert other is not state
    for each in (state, other):
        Trainer(each).run(6, lambda _: None)
    assert other.view == state.view
    for name, value in state.model.state_dict().items():
        assert torch.equal(value, other.model.state_dict()[name]), name


def test_more_gpus_than_there_are_are_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    state = SimpleNamespace(device=torch.device("cuda"))
    with pytest.raises(CapabilityError, match="gpus=2: torch sees 1 CUDA device here"), followed(state, None, 2):
        pass


def test_what_wraps_the_stage_or_adds_tasks_cannot_share_it():
    stage = stage_of(gpus=2)
    with pytest.raises(ConfigError, match="gpus=2 is for the plan of 3dgs alone"):
        WrappedStage(stage).running(SimpleNamespace(stage=None)).__enter__()
    stage.extra_tasks = (PlannedTask(False, 1, print),)
    with pytest.raises(ConfigError, match="gpus=2"):
        stage.running(SimpleNamespace(stage=stage)).__enter__()


def test_a_process_that_does_not_come_up_is_told():
    ended = SimpleNamespace(exitcode=1)
    with pytest.raises(SplatwizardError, match="ended before the first step"):
        wait_for([ended], threading.Semaphore(0))


def test_a_process_that_was_killed_is_told_and_one_that_failed_tells_itself():
    sleep = "import time; time.sleep(60)"
    for end, told in (("kill", "killed .SIGKILL"), ("exit", "lost another one")):
        process = subprocess.Popen([sys.executable, "-S", "-c", sleep if end == "kill" else "exit(1)"])
        if end == "kill":
            process.kill()
        exitcode = process.wait()
        reader, writer = os.pipe()
        os.close(writer)
        other = SimpleNamespace(sentinel=reader, exitcode=exitcode)
        with pytest.raises(SplatwizardError, match=told), followers._naming_killed([other]):
            raise SplatwizardError("process 0 of 2 of this training has lost another one")
        os.close(reader)


@pytest.mark.cuda
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="no two GPUs")
def test_a_run_on_two_gpus_ends_with_the_processes_that_it_started(scene, tmp_path):
    plugins, config = load_plugins(), config_of(gpus=2, iterations=200, **PLAN)
    method = ThreeDGS(plugins, config)
    outcome = TrainingRun(
        method.stages(), lambda: method.create_model(scene, torch.Generator()).cuda(), scene, PipelineParams(),
        NegotiatedRasterizer(plugins, device="cuda"), directory=tmp_path, identity={}, trained=pytest.fail,
    ).train()  # fmt: skip
    assert (outcome.figures.steps, multiprocessing.active_children()) == (100, [])
    assert outcome.model.num_rows > 300
