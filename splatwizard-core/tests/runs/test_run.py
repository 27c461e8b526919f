"""The run: every step once, in order, resumed where it stopped, and honest about what it finds."""

import json
from pathlib import Path
from typing import Any

import forked_children
import pytest
import torch

from splatwizard_core.base.lock import directory_lock
from splatwizard_core.cli.main import main
from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.errors import CheckpointError, RunLockedError, SplatwizardError, UserInputError
from splatwizard_core.plugins import PluginManager
from splatwizard_core.runs.config import ResolvedConfig, parse_set, resolve
from splatwizard_core.runs.decode import open_model, save_decoded, timed_decode
from splatwizard_core.runs.directory import RunRequest, run_directory
from splatwizard_core.runs.encode import encode_directory
from splatwizard_core.runs.facts import Measurement
from splatwizard_core.runs.fresh import FreshProcessError, decode_fresh, run_fresh
from splatwizard_core.runs.measure import measure, opener
from splatwizard_core.runs.record import Record, read_record
from splatwizard_core.runs.run import run, train_in, train_only
from splatwizard_core.runs.session import Session
from splatwizard_core.runs.training import trained_scene

pytestmark = pytest.mark.pipeline


def config(plugins: PluginManager, *sets: str, method: str = "toy", rate: str | None = None) -> ResolvedConfig:
    return resolve(plugins.methods.load(method), rate=rate, sets=parse_set(sets), scene="demo:tiny")


class Run:
    """One invocation: a session, and what it said."""

    def __init__(self, plugins: PluginManager, out: Path) -> None:
        self.plugins, self.out = plugins, out
        self.said: list[str] = []
        self.session = Session(plugins, torch.device("cpu"), self.said.append)

    def request(self, *sets: str, **options: str) -> RunRequest:
        return RunRequest(config(self.plugins, *sets, **options), self.out)

    def __call__(self, *sets: str, **options: str) -> tuple[Record, Path]:
        return run(self.session, self.request(*sets, **options))


@pytest.fixture(scope="module")
def done(toy_plugins: PluginManager, tmp_path_factory: pytest.TempPathFactory):
    """Two rate points, run one after the other: (records, what was said, root). The first starts new interpreters."""
    out = tmp_path_factory.mktemp("out")
    invocation = Run(toy_plugins, out)
    with forked_children.starting():
        first, _ = invocation("codec.fault=look around", rate="r1")
    second, _ = invocation("codec.fault=look around", rate="r2")
    return (first, second), invocation.said, out


def test_the_record_holds_what_the_protocol_asks_for(done):
    (_, record), _, out = done
    directory = out / "demo-tiny" / "toy" / "r2"
    assert read_record(directory / "metrics.json") == record
    assert record.distribution == "sw-toy 0.1"
    assert (record.preset, record.rate) == ("quick", "r2")
    assert record.protocol.id == "demo/64x48/r-1/every4/black/pp-center/q8"
    assert record.file.bytes == (directory / "scene.swz").stat().st_size == sum(record.file.sections.values())
    assert record.counts == {"num_gaussians": 60}
    assert record.train.steps == 6
    assert record.train.train_s is not None
    assert record.train.train_s > 0
    assert len(record.codec.decode_runs_s) == 3
    assert record.codec.decode_s == sorted(record.codec.decode_runs_s)[1]
    assert record.speed.views == 8  # the two test views are too few, so all cameras count
    assert record.memory.kind == "rss"
    assert "rss" in record.flags
    assert record.rasterizers["render"] == {"SPLIT_SH": "reference"}
    assert set(record.rasterizers["train"]) == {"BACKWARD+SPLIT_SH"}
    assert record.raster_options == {"train": {}, "render": {}}
    assert record.environment["packages"]["sw-toy"] == "0.1"
    assert record.plan[0].iterations == 6
    for name in ("config.toml", "log.jsonl", "renders/view_000.png", "renders/view_004.png"):
        home = directory if name != "log.jsonl" else directory.parent / "r1"  # where it was trained
        assert (home / name).is_file()


def test_options_of_rasterizers_reach_training_the_file_and_what_measures_it(toy_plugins, tmp_path: Path):
    invocation, decided = Run(toy_plugins, tmp_path), ("raster.antialias=true", "raster.profile=dgr-exact")
    request = invocation.request(*decided, "iterations=1")
    trained, directory = train_only(invocation.session, request)
    assert trained.facts.rasterizers == {"ANTIALIAS+BACKWARD+SPLIT_SH+profile dgr-exact": "reference"}
    encode_directory(invocation.session, request.resolved, directory, tmp_path / "x.swz")
    asked = {"antialias": True, "profile": "dgr-exact"}
    assert trained.facts.raster == ContainerReader.open(tmp_path / "x.swz").raster == asked

    def measured(*sets: str) -> Measurement:
        file = opener(tmp_path / "x.swz", invocation.session)
        return measure(invocation.session, config(toy_plugins, *sets), file, metrics=["psnr"], speed=False)

    as_file_asks, as_user_decides = measured(), measured("raster.antialias=false")
    assert as_file_asks.raster == asked
    assert as_file_asks.rasterizers == {"ANTIALIAS+SPLIT_SH+profile dgr-exact": "reference"}
    assert as_user_decides.raster == {"profile": "dgr-exact"}
    assert as_user_decides.metrics["psnr"].mean != as_file_asks.metrics["psnr"].mean


def test_metrics_come_from_the_registry_and_a_missing_one_says_why(done):
    (record, _), _, _ = done
    assert {name for name, metric in record.metrics.items() if not metric.diagnostic} == {
        "psnr", "ssim", "l1", "lpips_vgg_3dgs", "lpips_vgg", "lpips_alex", "toy-error", "toy-absent",
    }  # fmt: skip
    diagnostic = {name for name, metric in record.metrics.items() if metric.diagnostic}
    assert {"psnr_channel_mean", "psnr_unrounded", "ssim_valid", "ssim_reflect", "path_distance"} <= diagnostic
    assert len(record.metrics["toy-error"].per_view) == 2
    assert record.metrics["toy-error"].direction == "lower"
    assert record.metrics["toy-absent"].mean is None
    assert "toy weights are missing" in record.unknown["metrics.toy-absent.mean"]


def test_rate_points_that_differ_in_the_codec_alone_are_trained_once(done):
    (low, high), said, out = done
    assert sum(line.startswith("training toy") for line in said) == 1
    assert (out / "demo-tiny/toy/r1/checkpoints").is_dir()
    assert not (out / "demo-tiny/toy/r2/checkpoints").exists()
    assert high.train.trained_in == low.train.trained_in == "r1"
    assert high.train.train_s == low.train.train_s
    assert low.file.bytes < high.file.bytes


def test_a_finished_run_is_not_done_again(done, toy_plugins: PluginManager):
    _, _, out = done
    invocation = Run(toy_plugins, out)
    file = out / "demo-tiny/toy/r1/scene.swz"
    before = file.stat().st_mtime_ns
    invocation("codec.fault=look around", rate="r1")
    assert file.stat().st_mtime_ns == before
    assert invocation.said == [f"{file.parent} is finished; nothing to do (--fresh does it again)"]


def test_another_session_loads_the_shared_training(done, toy_plugins: PluginManager):
    """What r2 would encode is what r1 trained, also when it has to be read back from r1's checkpoints."""
    _, _, out = done
    invocation = Run(toy_plugins, out)
    request = invocation.request("codec.fault=look around", rate="r2")
    model = train_in(invocation.session, request, run_directory(request)).model
    decoded, _ = open_model(out / "demo-tiny/toy/r2/scene.swz", toy_plugins, torch.device("cpu"))
    assert torch.equal(model.means, decoded.means)


def test_the_evaluated_picture_is_the_decoded_one(done, toy_plugins: PluginManager):
    (_, record), _, out = done
    model, _ = open_model(out / "demo-tiny/toy/r2/scene.swz", toy_plugins, torch.device("cpu"))
    assert model.digest() == record.file.digest


def test_the_decoder_that_looks_around_fails_where_there_is_something_to_see(done):
    """The runs above are no proof unless the toy's check can fail."""
    _, _, out = done
    arguments = ["decode", "scene.swz", "--device", "cpu", "--repeats", "0", "--json"]
    with pytest.raises(FreshProcessError, match="AssertionError"):
        run_fresh(arguments, alone_in=out / "demo-tiny/toy/r2")


def test_a_directory_that_is_written_by_another_run_is_refused(toy_plugins: PluginManager, tmp_path: Path):
    invocation = Run(toy_plugins, tmp_path)
    with directory_lock(run_directory(invocation.request())), pytest.raises(RunLockedError):
        invocation()


def test_a_stopped_training_resumes_to_the_same_model(toy_plugins: PluginManager, tmp_path: Path):
    whole = Run(toy_plugins, tmp_path / "whole")
    expected, _ = train_only(whole.session, whole.request())
    stopped = Run(toy_plugins, tmp_path / "stopped")
    request = stopped.request()
    directory = run_directory(request)
    with pytest.raises(KeyboardInterrupt), directory_lock(directory):
        train_in(stopped.session, request, directory, stop_after=3)
    again = Run(toy_plugins, tmp_path / "stopped")
    resumed, _ = train_only(again.session, request)
    assert resumed.model.digest() == expected.model.digest()
    assert resumed.facts.steps == 6


def test_a_method_that_changes_the_model_it_encodes_is_found_out(toy_plugins: PluginManager, tmp_path: Path):
    with pytest.raises(SplatwizardError, match="method 'toy' changed the model while encoding"):
        Run(toy_plugins, tmp_path)("codec.fault=mutate", "iterations=1")


@pytest.mark.parametrize("asked", [False, True])
def test_where_equal_bits_are_asked_for_the_file_is_written_with_sums_in_one_order(
    asked: bool, toy_plugins: PluginManager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    invocation, found = Run(toy_plugins, tmp_path), []
    toy = toy_plugins.methods.load("toy")
    encode = toy.encode

    def watched(self: Any, model: Any, writer: Any) -> None:
        found.append(torch.are_deterministic_algorithms_enabled())
        encode(self, model, writer)

    monkeypatch.setattr(toy, "encode", watched)
    request = invocation.request("iterations=1", f"deterministic={str(asked).lower()}")
    _, directory = train_only(invocation.session, request)
    encode_directory(invocation.session, request.resolved, directory, tmp_path / "scene.swz")
    assert found == [asked]
    assert not torch.are_deterministic_algorithms_enabled()


def test_a_decoder_that_throws_dice_is_found_out(toy_plugins: PluginManager, tmp_path: Path):
    with pytest.raises(SplatwizardError, match="got different models from the same file"):
        Run(toy_plugins, tmp_path)("codec.fault=dice", "iterations=1")


def test_a_trained_scene_is_made_once_for_all_who_start_from_it(toy_plugins: PluginManager, tmp_path: Path):
    invocation = Run(toy_plugins, tmp_path)
    first, _ = train_only(invocation.session, invocation.request(method="toy-student"))
    assert invocation.said.count("no trained toy scene for this configuration yet: training it first") == 1
    (cached,) = (tmp_path / ".trained").iterdir()
    assert cached.name.startswith("demo-tiny-toy-")
    assert first.facts.pretraining["toy"].steps == 6  # its own preset `quick`

    again = Run(toy_plugins, tmp_path)
    resolved = config(toy_plugins, "iterations=2", method="toy-student")
    base = trained_scene(again.session, "toy", resolved, tmp_path)
    assert again.said == [f"toy-student starts from the trained toy scene in {cached}"]
    assert not any(p.requires_grad for p in base.model.parameters())


def test_a_trained_scene_of_an_ordinary_run_is_used(toy_plugins: PluginManager, tmp_path: Path):
    invocation = Run(toy_plugins, tmp_path)
    trained, _ = train_only(invocation.session, invocation.request())
    fresh = Run(toy_plugins, tmp_path)
    found = trained_scene(fresh.session, "toy", config(toy_plugins, method="toy-student"), tmp_path)
    assert found.model.digest() == trained.model.digest()
    assert not (tmp_path / ".trained").exists()


def test_fresh_processes_pass_on_what_went_wrong(toy_plugins: PluginManager, tmp_path: Path):
    broken = tmp_path / "scene.swz"
    broken.write_bytes(b"SPWZ")
    with pytest.raises(UserInputError, match=r"`sw decode` in a fresh process failed \(status 2\): .*truncated"):
        decode_fresh(broken, "cpu")


def said_by(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """What `sw ARGUMENTS --json` prints, run in this process."""
    assert main([*arguments, "--json"]) == 0, capsys.readouterr().err
    return json.loads(capsys.readouterr().out)


def test_eval_of_the_file_and_of_the_directory_reproduce_the_record(done, capsys: pytest.CaptureFixture[str]):
    (_, record), _, out = done
    directory = out / "demo-tiny/toy/r2"
    config_file = ["--config", str(directory / "config.toml"), "--no-speed"]
    of_file = said_by(["eval", str(directory / "scene.swz"), *config_file], capsys)
    assert of_file["metrics"]["psnr"]["per_view"] == record.metrics["psnr"].per_view
    assert of_file["digest"] == record.file.digest
    # r2 keeps float32, so the trained model is the decoded one.
    of_training = said_by(["eval", str(directory), "--no-speed", "--metrics", "psnr,ssim"], capsys)
    assert of_training["metrics"]["psnr"]["per_view"] == record.metrics["psnr"].per_view


def test_encode_of_a_directory_with_another_codec(done, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (low, _), _, out = done
    directory = str(out / "demo-tiny/toy/r2")
    target = tmp_path / "again.swz"
    facts = said_by(["encode", directory, "--set", "codec.kind=f2", "--out", str(target)], capsys)
    assert facts["bytes"] == target.stat().st_size == low.file.bytes
    told = said_by(["decode", str(target), "--out", str(tmp_path / "x.safetensors"), "--repeats", "1"], capsys)
    assert told["digest"] == low.file.digest
    assert len(told["decode_runs_s"]) == 1
    by_rate = said_by(["encode", directory, "--rate", "r1", "--out", str(target)], capsys)
    assert by_rate["sha256"] == low.file.sha256
    assert main(["encode", directory, "--rate", "r9"]) == 2
    assert "no rate point 'r9'" in capsys.readouterr().err
    assert main(["decode", directory]) == 2
    assert "the file in it is" in capsys.readouterr().err
    assert main(["encode", directory, "--set", "iterations=9"]) == 2
    assert "holds no finished training of this configuration" in capsys.readouterr().err


def test_a_decoded_model_is_kept_as_safetensors(done, tmp_path: Path, toy_plugins: PluginManager):
    from safetensors import safe_open

    (_, record), _, out = done
    session = Session(toy_plugins, torch.device("cpu"), print)
    model, report = timed_decode(out / "demo-tiny/toy/r2/scene.swz", session, repeats=0)
    save_decoded(model, report, tmp_path / "m.safetensors", toy_plugins)
    with safe_open(tmp_path / "m.safetensors", "pt") as file:
        assert file.metadata()["digest"] == record.file.digest
        assert torch.equal(file.get_tensor("means"), model.means)


def test_a_changed_configuration_does_not_replace_the_one_that_was_trained(toy_plugins: PluginManager, tmp_path: Path):
    invocation = Run(toy_plugins, tmp_path)
    _, directory = train_only(invocation.session, invocation.request("iterations=2"))
    before = (directory / "config.toml").read_text()
    with pytest.raises(CheckpointError, match="iterations: 2 -> 3"):
        train_only(invocation.session, invocation.request("iterations=3"))
    assert (directory / "config.toml").read_text() == before
    fresh = RunRequest(invocation.request("iterations=3").resolved, tmp_path, resume=False)
    assert train_only(invocation.session, fresh)[0].facts.steps == 3
    assert "iterations = 3" in (directory / "config.toml").read_text()


def test_starting_again_does_not_take_the_training_of_another_rate_point(toy_plugins: PluginManager, tmp_path: Path):
    old = Run(toy_plugins, tmp_path)
    train_only(old.session, old.request("iterations=2", rate="r2"))
    new = Run(toy_plugins, tmp_path)
    for rate in ("r1", "r2"):
        resolved = new.request("iterations=2", rate=rate).resolved
        found, _ = train_only(new.session, RunRequest(resolved, tmp_path, resume=False))
        assert found.facts.trained_in == "r1"
    assert sum(line.startswith("training toy") for line in new.said) == 1
    assert (tmp_path / "demo-tiny/toy/r1/checkpoints").is_dir()  # else nothing would be left to encode again
