"""What a training starts from: a trained scene of another method, or a .ply of somebody else's."""

import json
import os
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
import torch
from forked_children import start_python
from sw_gaussians.ply import export_ply
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.base.lock import directory_lock
from splatwizard_core.cli.main import main
from splatwizard_core.cli.setup import Choices
from splatwizard_core.errors import CheckpointError, ConfigError, SplatwizardError, UserInputError
from splatwizard_core.plugins import PluginManager
from splatwizard_core.runs.config import ResolvedConfig, parse_set, resolve
from splatwizard_core.runs.directory import RunRequest
from splatwizard_core.runs.identity import training_key
from splatwizard_core.runs.pretrained import check_model, checked_start
from splatwizard_core.runs.record import Record, missing_reasons
from splatwizard_core.runs.run import run, train_only
from splatwizard_core.runs.session import Session
from splatwizard_core.runs.training import trained_scene
from splatwizard_core.scene.scene import PointCloud

pytestmark = pytest.mark.pipeline


class Run:
    """One invocation: a session, and what it said."""

    def __init__(self, plugins: PluginManager, out: Path) -> None:
        self.plugins, self.out = plugins, out
        self.said: list[str] = []
        self.session = Session(plugins, torch.device("cpu"), self.said.append)

    def resolved(self, *sets: str, method: str = "toy-student", preset: str | None = None) -> ResolvedConfig:
        cls = self.plugins.methods.load(method)
        return checked_start(self.plugins, resolve(cls, preset, sets=parse_set(sets), scene="demo:tiny"))

    def train(self, *sets: str, **options: str):
        return train_only(self.session, RunRequest(self.resolved(*sets, **options), self.out))

    def __call__(self, *sets: str, **options: str) -> tuple[Record, Path]:
        return run(self.session, RunRequest(self.resolved(*sets, **options), self.out))


def write_ply(path: Path, count: int = 90, seed: int = 0) -> Path:
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator) - 0.5
    export_ply(gaussians_from_points(PointCloud(points, torch.full((count, 3), 0.5)), max_sh_degree=1), path)
    return path


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    return write_ply(tmp_path / "foreign.ply")


def test_a_run_starts_from_a_file_in_place_of_a_trained_scene(toy_plugins, tmp_path, ply):
    invocation = Run(toy_plugins, tmp_path / "out")
    record, directory = invocation(f"init={ply}")
    assert f"toy-student starts from {ply} in place of a trained toy scene" in invocation.said
    assert not (tmp_path / "out/.trained").exists()
    assert record.counts == {"num_gaussians": 90}
    (name,), scene = record.train.pretraining, record.train.pretraining["toy"]
    assert name == "toy"
    assert scene.file["name"] == "foreign.ply"
    assert scene.train_s is None
    assert "came from a file" in record.unknown["train.pretraining.toy.train_s"]
    assert record.train.with_pretraining_s is None
    assert "came from a file" in record.unknown["train.with_pretraining_s"]
    assert record.train.train_s > 0
    assert missing_reasons(record) == []
    assert record.config["init"] == str(ply)
    assert f'init = "{ply}"' in (directory / "config.toml").read_text()


def test_the_config_of_a_run_from_a_file_repeats_it(toy_plugins, tmp_path, ply):
    _, directory = Run(toy_plugins, tmp_path / "out").train(f"init={ply}")
    again = resolve(toy_plugins.methods.load("toy-student"), config_file=directory / "config.toml")
    session = Session(toy_plugins, torch.device("cpu"), print)
    first = Run(toy_plugins, tmp_path).resolved(f"init={ply}")
    assert training_key(session, again) == training_key(session, first)


def test_what_a_file_is_drawn_with_is_kept_where_nothing_is_trained(toy_plugins, tmp_path):
    """A model without steps is the file's; one with steps has learned to be drawn as its method does."""
    model = gaussians_from_points(PointCloud(torch.rand(9, 3), torch.full((9, 3), 0.5)), max_sh_degree=1)
    model.origin = {"raster": {"antialias": True}}
    export_ply(model, tmp_path / "smooth.ply")

    def asked(*sets: str) -> dict[str, object]:
        trained, _ = Run(toy_plugins, tmp_path / "out" / str(len(sets)) / sets[0]).train(
            f"init={tmp_path / 'smooth.ply'}", *sets
        )
        return trained.facts.raster

    assert asked("iterations=0") == {"antialias": True}
    assert asked("iterations=0", "raster.antialias=false") == {}
    assert asked("iterations=1") == {}


def test_a_teacher_is_the_file_too(toy_plugins, tmp_path, ply):
    invocation = Run(toy_plugins, tmp_path / "out")
    found, _ = invocation.train(f"init={ply}", method="toy-taught")
    assert found.model.counts() == {"num_gaussians": 90}
    assert not (tmp_path / "out/.trained").exists()


def test_what_the_file_holds_tells_trainings_apart_and_not_where_it_lies(toy_plugins, tmp_path, ply):
    copy = tmp_path / "copy.ply"
    copy.write_bytes(ply.read_bytes())
    other = write_ply(tmp_path / "other.ply", seed=1)

    def key(*sets: str) -> str:
        return training_key(
            Session(toy_plugins, torch.device("cpu"), print), Run(toy_plugins, tmp_path).resolved(*sets)
        )

    assert key(f"init={ply}") == key(f"init={copy}") != key(f"init={other}")
    assert key() != key(f"init={ply}")
    # How the scene is trained that it starts from is part of what it is, too.
    assert len({key(), key("pretrained.iterations=3"), key("pretrained.preset=paper")}) == 3
    assert key("pretrained.iterations=8") == key("pretrained.preset=paper")


def test_another_file_is_another_training_and_told_so(toy_plugins, tmp_path, ply):
    other = write_ply(tmp_path / "other.ply", seed=1)
    Run(toy_plugins, tmp_path / "out").train(f"init={ply}")
    with pytest.raises(CheckpointError, match=r"starts from\.toy\.file: sha256"):
        Run(toy_plugins, tmp_path / "out").train(f"init={other}")


def test_the_values_of_what_is_started_from_are_set_and_recorded(toy_plugins, tmp_path):
    record, directory = Run(toy_plugins, tmp_path)("pretrained.iterations=3", "iterations=2")
    scene = record.train.pretraining["toy"]
    assert (scene.steps, scene.preset, scene.config["iterations"]) == (3, "quick", 3)
    assert scene.made_by["sw-toy"] == "0.1"
    assert record.train.steps == 2
    assert record.train.with_pretraining_s == pytest.approx(record.train.train_s + scene.train_s)
    assert record.config["pretrained"] == {"iterations": 3}
    assert record.config["provenance"]["pretrained.iterations"] == "--set"
    again = resolve(toy_plugins.methods.load("toy-student"), config_file=directory / "config.toml")
    assert again.pretrained == {"iterations": 3}


def test_the_preset_of_a_run_is_that_of_what_it_starts_from(toy_plugins, tmp_path):
    invocation = Run(toy_plugins, tmp_path)
    for preset, steps in (("quick", 6), ("paper", 8)):
        found = trained_scene(invocation.session, "toy", invocation.resolved(preset=preset), tmp_path)
        assert found.facts.steps == steps


@pytest.mark.parametrize(
    ("method", "sets", "told"),
    [
        ("toy", ["init=FILE"], "method 'toy' does not start from a trained scene, so 'init'"),
        ("toy", ["pretrained.iterations=3"], "so 'pretrained.iterations' is of no use to it"),
        ("toy-student", ["pretrained.itertions=3"], "unknown key 'pretrained.itertions'.*'pretrained.iterations'"),
        ("toy-student", ["pretrained.iterations=-3"], "bad value '-3' for 'pretrained.iterations'"),
        ("toy-student", ["pretrained.seed=3"], "'pretrained.seed' is no key of 'toy' but one of the run: give 'seed'"),
        ("toy-student", ["pretrained.preset=none"], "no preset 'none'"),
        ("toy-student", ["init=FILE", "pretrained.iterations=3"], "give one of them"),
        ("toy-student", ["pretrained=3"], "unknown key 'pretrained'"),
    ],
)
def test_wrong_keys_about_what_a_method_starts_from(toy_plugins, tmp_path, ply, method, sets, told):
    with pytest.raises(ConfigError, match=told):
        Run(toy_plugins, tmp_path).resolved(*(text.replace("FILE", str(ply)) for text in sets), method=method)


def test_wrong_files(tmp_path, ply):
    damaged = gaussians_from_points(PointCloud(torch.rand(4, 3), torch.rand(4, 3)), max_sh_degree=0)
    with torch.no_grad():
        damaged.means[1, 2] = float("nan")
    export_ply(damaged, tmp_path / "nan.ply")
    (tmp_path / "x.swz").write_bytes(b"SPWZ....")
    (tmp_path / "cut.ply").write_bytes(ply.read_bytes()[:-9])
    for name, told in {
        "none.ply": "there is no such file",
        "x.swz": "is an encoded file: `sw export",
        "cut.ply": f"init: {tmp_path}/cut.ply: ",
        ".": f"is a folder: name the .ply in it, such as {tmp_path}/nan.ply",
    }.items():
        with pytest.raises(UserInputError, match=told):
            check_model(str(tmp_path / name) if name != "." else str(tmp_path))
    assert check_model(str(ply)).num_rows == 90


def test_a_scene_that_no_stage_names_is_refused(toy_plugins, tmp_path):
    with pytest.raises(SplatwizardError, match="asks for a trained 'toy' scene, which no stage names"):
        Run(toy_plugins, tmp_path).train(method="toy-secret")


def test_rate_points_and_teachers_do_not_read_it_again(toy_plugins, tmp_path):
    invocation = Run(toy_plugins, tmp_path)
    first = trained_scene(invocation.session, "toy", invocation.resolved(), tmp_path)
    second = trained_scene(invocation.session, "toy", invocation.resolved("iterations=3"), tmp_path)
    assert second is first
    other = trained_scene(invocation.session, "toy", invocation.resolved("pretrained.iterations=2"), tmp_path)
    assert other.facts.steps == 2


def test_of_several_methods_those_that_start_from_nothing_leave_it_to_the_others(toy_plugins, tmp_path, ply, capsys):
    from splatwizard_core.cli.setup import Choices

    def resolved(*methods: str, **values: str) -> list[ResolvedConfig]:
        sets = tuple(f"{key}={value}" for key, value in values.items())
        return Choices(methods=methods, sets=sets, scene="demo:tiny").resolve(toy_plugins)

    plain, student = resolved("toy", "toy-student", init=str(ply))
    assert (plain.init, student.init) == ("", str(ply))
    assert "toy does not start from a trained scene: 'init' is for the others" in capsys.readouterr().err
    # One that is taught by a trained scene has no use for a start, and one for the values of its teacher.
    for method in ("toy", "toy-pupil"):
        with pytest.raises(ConfigError, match="does not start from a trained scene"):
            resolved(method, init=str(ply))
    pupil, taught = resolved("toy-pupil", "toy", **{"pretrained.iterations": "3"})
    assert (pupil.pretrained, taught.pretrained) == ({"iterations": 3}, {})


def test_what_is_set_also_trains_what_a_method_starts_from(toy_plugins, tmp_path):
    def resolved(*methods: str, sets: tuple[str, ...] = ("iterations=3", "codec.kind=f2", "log_every=5"), **more):
        return Choices(methods, sets=sets, **more).resolve(toy_plugins)

    plain, student = resolved("toy", "toy-student")
    assert (plain.config.iterations, dict(plain.pretrained)) == (3, {})
    assert (student.config.iterations, dict(student.pretrained)) == (3, {"iterations": 3})
    told: list[str] = []
    Choices(("toy",), preset="quick").settled([plain, student], toy_plugins, lambda each: None, told.append)
    about = "toy-student: the trained scene that it starts from has iterations=3 too"
    assert told == [f"{about} (--set pretrained.KEY=VALUE decides)"]
    (alone,) = resolved("toy-student")
    assert alone == student
    assert not resolved("toy-student", sets=("iterations=0",))[0].pretrained  # a trained scene has steps
    (file := tmp_path / "some.toml").write_text("method = 'toy-student'\niterations = 3\n")
    (said,) = resolved("toy-student", sets=(), config_file=str(file))
    assert dict(said.pretrained) == {"iterations": 3}
    file.write_text(replace(alone, pretrained={}).toml())  # of a run, whose table `pretrained` says it all
    assert not resolved("toy-student", sets=(), config_file=str(file))[0].pretrained
    _, own = resolved("toy", "toy-student", sets=("iterations=3", "pretrained.iterations=5"))
    assert dict(own.pretrained) == {"iterations": 5}


def test_a_teacher_is_trained_as_asked(toy_plugins, tmp_path):
    found, _ = Run(toy_plugins, tmp_path).train("pretrained.iterations=2", method="toy-pupil")
    assert found.facts.pretraining["toy"].steps == 2
    assert [phase.phase for phase in found.facts.phases] == ["train: toy", "train: taught"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_is_told_as_such(toy_plugins, tmp_path, capsys):
    pipes = [tmp_path / "x.ply", tmp_path / "x.swz", tmp_path / "x"]
    for pipe in pipes:
        os.mkfifo(pipe)
    told = "no file but a pipe or a device: write what comes out of it into a file first"
    with pytest.raises(UserInputError, match=f"init: .*x.ply: {told}"):
        check_model(str(pipes[0]))
    training = ["train", "--method", "toy-student", "--out", str(tmp_path), "--set", "init_points=3", "--init"]
    for words in (["eval", "--scene", "demo:tiny"], ["decode", "--out", str(tmp_path / "y")], ["encode"],
                  training, [*training[:-1], "--scene"]):  # fmt: skip
        for pipe in pipes:
            assert main([*words, str(pipe)]) == 2
            assert told in capsys.readouterr().err, (words, pipe)


def test_an_interrupted_scene_is_gone_on_with(toy_plugins, tmp_path):
    from splatwizard_core.runs.pretrained import base_config
    from splatwizard_core.runs.training import cached_directory, train

    invocation = Run(toy_plugins, tmp_path)
    resolved = invocation.resolved()
    base = base_config(toy_plugins, "toy", resolved)
    directory = cached_directory(invocation.session, base, tmp_path)
    with pytest.raises(KeyboardInterrupt), directory_lock(directory):
        train(invocation.session, RunRequest(base, tmp_path), directory, stop_after=2)
    trained_scene(invocation.session, "toy", resolved, tmp_path)
    assert "the trained toy scene for this configuration is not finished yet: going on with it first" in invocation.said
    assert "going on after step 2 of 6" in invocation.said


def test_an_ordinary_run_takes_what_others_started_from(toy_plugins, tmp_path):
    first = Run(toy_plugins, tmp_path)
    first.train()
    again = Run(toy_plugins, tmp_path)
    found, directory = again.train(method="toy")
    assert not any(line.startswith("training toy on") for line in again.said)
    assert any("shares the training that others started from" in line for line in again.said)
    assert (directory / "log.jsonl").is_file()
    assert found.facts.steps == 6


def test_a_finished_student_is_encoded_from_its_directory(toy_plugins, tmp_path, capsys):
    _, directory = Run(toy_plugins, tmp_path / "out").train()
    assert main(["encode", str(directory), "--out", str(tmp_path / "x.swz"), "--json"]) == 0
    facts, size = json.loads(capsys.readouterr().out), (tmp_path / "x.swz").stat().st_size
    assert facts["bytes"] == size
    assert facts["ratio"] == facts["float32_bytes"] / size
    assert main(["eval", str(tmp_path / "x.swz"), "--scene", "demo:tiny", "--no-speed", "--json"]) == 0
    assert facts["psnr"] == pytest.approx(json.loads(capsys.readouterr().out)["metrics"]["psnr"]["mean"])
    assert main(["encode", str(directory), "--out", str(tmp_path / "x.swz"), "--no-psnr"]) == 0
    told = capsys.readouterr().out
    assert f"{size:,} bytes, {1 / facts['ratio']:.1f} x larger than its parameters as float32, in " in told  # a toy


def sw_train(method: str, out: Path, **environment: str) -> "subprocess.Popen[str]":
    command = ["-m", "splatwizard_core", "train", "--method", method, "--scene", "demo:tiny", "--out", str(out)]
    return start_python(*command, env={**os.environ, **environment}, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("first", ["toy-student", "toy"])
def test_two_processes_that_want_the_same_scene_train_it_once(toy_plugins, tmp_path, first):
    """The second comes while the first trains it: to start from it, or as a run of its own.

    The first stops itself before its first checkpoint, until the second has found it at work.
    """
    stop = str(int(signal.SIGSTOP))
    one = sw_train(
        first, tmp_path, TOY_DEATH="train:/checkpoints", TOY_SIGNAL=stop, TOY_WRITES=str(tmp_path / "writes")
    )
    while psutil.Process(one.pid).status() != psutil.STATUS_STOPPED:
        assert one.poll() is None, one.communicate()
        time.sleep(0.01)
    two = sw_train("toy-taught", tmp_path)
    assert two.stderr is not None
    lines: list[str] = []
    while not any("is being written by process" in line for line in lines):
        lines.append(two.stderr.readline())
        if lines[-1] == "":
            one.kill()
            pytest.fail(f"it has not waited: {lines}")
    one.send_signal(signal.SIGCONT)
    told = [one.communicate()[1], "".join(lines) + two.communicate()[1]]
    assert (one.returncode, two.returncode) == (0, 0), told
    assert sum(text.count("training toy on ") for text in told) == 1
    assert f"is being written by process {one.pid}" in told[1]
    assert "toy-taught starts from the trained toy scene in " in told[1]
    trained = list((tmp_path / ".trained").glob("*")) if first != "toy" else []
    assert len(trained) == (first != "toy")
    assert os.path.isdir(tmp_path / "demo-tiny" / "toy-taught")
