"""A small method of its own distribution, found through an entry point also by fresh processes."""

import importlib
import importlib.metadata
import os
from pathlib import Path

import pytest
import torch

from splatwizard_native import cache_root

TOY = '''
"""Methods for tests: `toy` trains Gaussians for a few steps; `toy-student` starts from a trained toy scene."""

import os
import sys
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.method import Method
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.scene.scene import PointCloud
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from splatwizard_core.training.params import OptimizationParams, Params
from splatwizard_core.training.stage import Stage

NAMES = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")


class Codec(Params):
    kind: Literal["f2", "f4"] = "f4"
    fault: str = Field("", description="what to do wrong, for tests of the runner")


class ToyConfig(OptimizationParams):
    iterations: int = Field(8, ge=0)
    codec: Codec = Codec()


class ToyStage(Stage):
    name = "toy"

    def create_optimizer(self, model, scene):
        return SplatOptimizer(model, [ParamGroup("sh_dc", 0.02), ParamGroup("means", 1e-3)])


class Toy(Method):
    name = "toy"
    Config = ToyConfig
    PRESETS = {"paper": {}, "quick": {"iterations": 6}}
    RATES = {"r1": {"codec.kind": "f2"}, "r2": {}}
    DEFAULT_RATE = "r2"

    def create_model(self, scene, generator):
        points = PointCloud(scene.points.xyz[:60], scene.points.rgb[:60])
        return gaussians_from_points(points, max_sh_degree=1)

    def stages(self) -> Sequence[Stage]:
        return [ToyStage(self.config)]

    def encode(self, model, writer):
        codec = self.config.codec
        writer.static["fault"] = codec.fault
        for name in NAMES:
            writer.add_array(name, getattr(model, name).detach().cpu().numpy().astype("<" + codec.kind))
        if codec.fault == "mutate":
            with torch.no_grad():
                model.means.add_(1)

    def decode(self, reader):
        # What a decoder may see: its file, in a folder that holds nothing else, and no way to the data.
        if reader.static["fault"] == "look around" and sys.argv[1:2] == ["decode"]:
            assert os.listdir(".") == ["scene.swz"], os.listdir(".")
            assert "SPLATWIZARD_DATA" not in os.environ
        tensors = {}
        for name in NAMES:
            dtype = "<f2" if len(reader.section("means")) < 60 * 3 * 4 else "<f4"
            tensors[name] = torch.from_numpy(reader.array(name, dtype=dtype).astype(np.float32))
        if reader.static["fault"] == "dice":
            tensors["means"] = tensors["means"] + torch.rand(1, generator=torch.Generator().manual_seed(os.getpid()))
        return GaussianModel.from_tensors(**tensors)


class StudentStage(ToyStage):
    name = "student"

    @property
    def starts_from(self):
        return "toy"


class Student(Toy):
    name = "toy-student"

    def stages(self):
        return [StudentStage(self.config)]


class TaughtStage(ToyStage):
    name = "taught"
    taught_by = ("toy",)

    def begin(self, context):
        assert not any(p.requires_grad for p in context.trained("toy").parameters())
        return context.model


class Taught(Toy):
    """A student that its teacher teaches once more."""

    name = "toy-taught"

    def stages(self):
        return [StudentStage(self.config), TaughtStage(self.config)]


class Pupil(Toy):
    """Begins by itself, and is taught later."""

    name = "toy-pupil"

    def stages(self):
        return [ToyStage(self.config), TaughtStage(self.config)]


class SecretStage(TaughtStage):
    taught_by = ()


class Secret(Toy):
    name = "toy-secret"

    def stages(self):
        return [SecretStage(self.config)]
'''

HELPER = '''
"""What another distribution lends: a stage, a task, a pruner, a coder. And `borrower`, a method made of such."""

import torch
import toy_method
from splatwizard_core.method import create_method
from splatwizard_core.plugins import hookimpl
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.training.optimizer import SplatOptimizer
from splatwizard_core.training.task_log import TaskLog


@hookimpl
def register_methods(registry):
    registry.add("borrower", "toy_helper:Borrower", summary="for tests")


@hookimpl
def register_pruners(registry):
    registry.add("toy-pruner", "toy_helper:ToyPruner", summary="for tests")


@hookimpl
def register_coders(registry):
    registry.add("toy-coder", "toy_helper:ToyPruner", summary="for tests")
    registry.add("fixed-coder", "toy_helper:ToyPruner", summary="imported, not asked for")


@hookimpl
def register_tasks(registry):
    registry.add("dim", "toy_helper:Dim", summary="for tests", factory=True)
    registry.add("look", "toy_helper:look", summary="for tests", factory=False)


NOTES = []
WATCH = False
FAILS_AT = 0


@hookimpl
def run_started(training):
    if WATCH:
        NOTES.append(f"started {training.method} {training.directory.name} {training.scene.name}")
        return Watcher()


class Watcher:
    """Draws random numbers, which the training must not notice."""

    def after_step(self, model, record):
        if record.step == FAILS_AT:
            raise OSError("no screen")
        torch.rand(3)
        NOTES.append(f"step {record.step} of {model.num_rows}")

    def finished(self):
        NOTES.append("finished")


class ToyPruner:
    pass


def look(optimizer: SplatOptimizer) -> None:
    pass


class Dim:
    """A task that makes everything fainter, and counts how often it has."""

    def __init__(self, *, by: float = 0.5, floor: float = -4.0):
        if by < 0:
            raise ValueError(f"by is {by}: it must be at least 0")
        self.by, self.floor, self.calls = by, floor, 0

    def __call__(self, model: GaussianModel, log: TaskLog) -> None:
        self.calls += 1
        model.opacity_logits.sub_(self.by).clamp_(min=self.floor)
        log.scalar("dimmed", self.calls)

    def state_dict(self):
        return {"calls": self.calls}

    def load_state_dict(self, state):
        self.calls = state["calls"]


class Second(toy_method.ToyStage):
    name = "second"

    def __init__(self, opt, plugins):
        super().__init__(opt)
        self.plugins = plugins

    def begin(self, context):
        self.plugins.pruners.load("toy-pruner")
        return context.model


class Borrower(toy_method.Toy):
    name = "borrower"

    def stages(self):
        (first,) = create_method(self.plugins, "toy", {"iterations": 3}).stages()
        register = first.register_pre_task

        def with_look(scheduler, ppl, opt):
            register(scheduler, ppl, opt)
            scheduler.register_task(2, look, name="look")

        first.register_pre_task = with_look
        return [first, Second(self.config, self.plugins)]

    def encode(self, model, writer):
        self.plugins.coders.load("toy-coder")
        writer.require("coder", "fixed-coder")
        super().encode(model, writer)
'''

DEATH = """
import os
import sys

WRITES = ("os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.truncate")
OPENED_TO_WRITE = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def die_before_a_write(when, notes, signal=9):
    '''Kill this process, and of a child its parent first, before the n-th time that it changes what is on a disk.

    when    COMMAND:N, such as run:7; N = 0: never. Or COMMAND:TEXT: the first time that the line about it holds TEXT
    notes   path of a file that gets a line for each such time
    signal  what it is sent: another one than SIGKILL may only stop it for a while
    '''
    command, _, count = when.partition(":")
    mine = sys.argv[1]
    if mine != command and count != "0":
        return
    left = int(count) if count.isdigit() else -1
    lines = os.open(notes, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def watch(event, arguments):
        nonlocal left
        if event == "open":
            if str(arguments[0]).startswith(("/dev/", "/proc/")) or not (arguments[2] or 0) & OPENED_TO_WRITE:
                return
        elif event not in WRITES:
            return
        line = f"{mine} {event} {arguments[0]}"
        os.write(lines, f"{line}\\n".encode())
        left -= 1
        if left == 0 or (left < 0 and count in line and not count.isdigit()):
            left = sys.maxsize  # once
            if mine in ("decode", "eval"):
                os.kill(os.getppid(), signal)
            os.kill(os.getpid(), signal)

    sys.addaudithook(watch)
"""

PLUGIN = """
import os

from splatwizard_core.plugins import hookimpl

if "TOY_DEATH" in os.environ:
    import toy_death

    toy_death.die_before_a_write(
        os.environ["TOY_DEATH"], os.environ["TOY_WRITES"], int(os.environ.get("TOY_SIGNAL", "9"))
    )


@hookimpl
def register_methods(registry):
    registry.add("toy", "toy_method:Toy", summary="for tests")
    registry.add("toy-student", "toy_method:Student", summary="for tests")
    registry.add("toy-taught", "toy_method:Taught", summary="for tests")
    registry.add("toy-pupil", "toy_method:Pupil", summary="for tests")
    registry.add("toy-secret", "toy_method:Secret", summary="for tests")


@hookimpl
def register_metrics(registry):
    registry.add("toy-error", "toy_plugin:largest_error", summary="largest absolute error", direction="lower")
    registry.add("toy-absent", "toy_plugin:absent", summary="never there", direction="lower")


def largest_error(render, truth):
    return float((render - truth).abs().max())


def absent(render, truth):
    from splatwizard_core.errors import CapabilityError

    raise CapabilityError("toy weights are missing: get them somewhere")
"""


OURS = "gaussians,datasets,metrics,reference"
"""Packages that a run on the procedural scene needs beside the toy; no rasterizer's kernels: the reference draws."""


@pytest.fixture(scope="session")
def toy_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for PYTHONPATH that holds the distributions sw-toy and sw-helper."""
    site = tmp_path_factory.mktemp("site")
    (site / "toy_method.py").write_text(TOY)
    (site / "toy_plugin.py").write_text(PLUGIN)
    (site / "toy_death.py").write_text(DEATH)
    (site / "toy_helper.py").write_text(HELPER)
    for name, version, key, module in (("toy", "0.1", "toy", "toy_plugin"), ("helper", "0.7", "helper", "toy_helper")):
        info = site / f"sw_{name}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: sw-{name}\nVersion: {version}\n")
        (info / "entry_points.txt").write_text(f"[splatwizard]\n{key} = {module}\n")
    built = cache_root() / "native"
    built.mkdir(parents=True, exist_ok=True)
    (site / "cache").mkdir()
    (site / "cache" / "native").symlink_to(built, target_is_directory=True)  # compiling them takes half a minute
    return site


@pytest.fixture(scope="module")
def toy_plugins(toy_site: Path):
    """The plugin manager with the core and sw-toy alone, here and in every process started from here."""
    yield from _restricted(toy_site, f"toy,{OURS}")


@pytest.fixture(scope="module")
def helped_plugins(toy_site: Path):
    """The same with sw-helper."""
    yield from _restricted(toy_site, f"toy,helper,{OURS}")


def _restricted(toy_site: Path, only: str):
    from splatwizard_core.plugins import load_plugins

    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(toy_site))
        # The kernels of installed plugins stay out of it: these tests are about the run.
        patch.setenv("SW_PLUGINS", only)
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(toy_site), os.environ.get("PYTHONPATH", "")])))
        patch.setenv("SPLATWIZARD_DATA", str(toy_site))
        patch.setenv("SPLATWIZARD_CACHE", str(toy_site / "cache"))
        # Sixty Gaussians are no work to share, and waiting threads take the cores from the other tests.
        patch.setenv("OMP_NUM_THREADS", "1")
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        importlib.invalidate_caches()
        load_plugins.cache_clear()
        yield load_plugins()
        torch.set_num_threads(threads)
    load_plugins.cache_clear()
