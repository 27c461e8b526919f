"""Who served which phase: the stage by its class, tasks of others, pruners, coders, rasterizers, with distributions."""

import functools
import json
from pathlib import Path

import pytest
import torch

from splatwizard_core.base.lock import directory_lock
from splatwizard_core.cli.main import main
from splatwizard_core.errors import BitstreamError
from splatwizard_core.plugins.origins import Origins
from splatwizard_core.runs.config import parse_set, resolve
from splatwizard_core.runs.directory import RunRequest, run_directory
from splatwizard_core.runs.facts import EncodingFacts, Measurement, TrainingFacts
from splatwizard_core.runs.phases import named_parts, part_of, phases_of_run
from splatwizard_core.runs.record import MetricBlock
from splatwizard_core.runs.run import run, train_in
from splatwizard_core.runs.session import Session
from splatwizard_core.training.stage import Stage

pytestmark = pytest.mark.pipeline
CORE = ("splatwizard-core", "0.1.0")


def request_of(plugins, out: Path, method: str = "borrower") -> RunRequest:
    resolved = resolve(plugins.methods.load(method), sets=parse_set(["iterations=4"]), scene="demo:tiny")
    return RunRequest(resolved, out)


def session(plugins) -> Session:
    return Session(plugins, torch.device("cpu"), lambda line: None)


def told(phases) -> dict[str, list[tuple[str, ...]]]:
    """Phase -> parts, of the blocks of a record as plain values."""
    return {phase["phase"]: [tuple(part.values()) for part in phase["provided_by"]] for phase in phases}


@pytest.fixture(scope="module")
def expected(helped_plugins):
    reference = helped_plugins.rasterizers.entry("reference")
    drawn = ("rasterizer", "reference", reference.distribution, reference.version)
    return {
        # The stage is borrowed from sw-toy, one of its tasks is the helper's.
        "train: toy": [("stage", "toy", "sw-toy", "0.1"), ("task", "look", "sw-helper", "0.7"), drawn],
        "train: second": [("stage", "second", "sw-helper", "0.7"), ("pruner", "toy-pruner", "sw-helper", "0.7"), drawn],
        "encode": [
            ("method", "borrower", "sw-helper", "0.7"),
            ("coder", "toy-coder", "sw-helper", "0.7"),
            ("coder", "fixed-coder", "sw-helper", "0.7"),
        ],
        "render": [drawn],
    }


@pytest.fixture(scope="module")
def finished(helped_plugins, tmp_path_factory):
    """(record, out) of a whole run."""
    out = tmp_path_factory.mktemp("out")
    return run(session(helped_plugins), request_of(helped_plugins, out))[0], out


def test_each_phase_of_a_run_names_who_served_it(finished, expected):
    record, _ = finished
    found = told(record.model_dump()["phases"])
    measured = [name for name, metric in record.metrics.items() if metric.per_view]
    assert {"psnr", "ssim", "l1"} <= set(measured)
    assert [(kind, name) for kind, name, *_ in found["evaluate"]] == [("metric", name) for name in measured]
    assert {of for _, name, of, *_ in found.pop("evaluate") if name in ("psnr", "ssim", "l1")} == {CORE[0]}
    assert found == expected


@pytest.mark.parametrize("stop", [2, 5])
def test_a_resumed_training_names_what_served_before(helped_plugins, tmp_path, expected, stop):
    request = request_of(helped_plugins, tmp_path)
    directory = run_directory(request)
    with pytest.raises(KeyboardInterrupt), directory_lock(directory):
        train_in(session(helped_plugins), request, directory, stop_after=stop)
    with directory_lock(directory):
        facts = train_in(session(helped_plugins), request, directory).facts
    assert told(facts.model_dump()["phases"]) == {name: expected[name] for name in ("train: toy", "train: second")}


def test_what_a_scene_that_is_started_from_asks_for_is_not_told_of_the_stage(helped_plugins, tmp_path):
    request = request_of(helped_plugins, tmp_path, "toy-student")
    directory = run_directory(request)
    with directory_lock(directory):
        facts = train_in(session(helped_plugins), request, directory).facts
    assert [phase.phase for phase in facts.phases] == ["train: student"]
    assert [part.kind for part in facts.phases[0].provided_by] == ["stage", "rasterizer"]


def test_a_metric_without_a_value_served_nothing(helped_plugins):
    metrics = {
        name: MetricBlock(per_view=values, mean=mean)
        for name, values, mean in (
            ("psnr", [30.0], 30.0), ("l1", [], None), ("gone", [1.0], None), ("mesh", [], 0.01),
        )
    }  # fmt: skip
    phases = phases_of_run(
        helped_plugins,
        TrainingFacts(),
        EncodingFacts(encode_s=0.0, bytes=1, sha256=""),
        Measurement.model_construct(rasterizers={}, metrics=metrics),
    )
    psnr = helped_plugins.metrics.entry("psnr")
    assert psnr.distribution == CORE[0]
    assert told([phase.model_dump() for phase in phases])["evaluate"] == [
        ("metric", "psnr", psnr.distribution, psnr.version), ("metric", "gone", "", ""), ("metric", "mesh", "", ""),
    ]  # fmt: skip
    assert named_parts(helped_plugins, "metric", ["psnr", "psnr"]) == [part_of(psnr)]


def test_a_thing_comes_from_the_distribution_of_its_module(helped_plugins):
    origins = Origins(helped_plugins)
    toy = helped_plugins.methods.load("toy")
    assert origins.of(toy) == origins.of(toy(helped_plugins, toy.Config())) == ("sw-toy", "0.1")
    assert origins.of(helped_plugins.pruners.load("toy-pruner")) == ("sw-helper", "0.7")
    assert origins.of(Stage)[0] == CORE[0]
    assert origins.of(BitstreamError)[0] == CORE[0]
    assert origins.of(functools.partial(toy.decode, None)) == ("sw-toy", "0.1")
    assert origins.of(torch.nn.Module)[0] == "torch"  # no plugin: what its metadata says
    assert origins.of(test_a_thing_comes_from_the_distribution_of_its_module) == ("", "")
    assert origins.of(print) == ("", "")


def test_info_of_a_record_says_who_served(helped_plugins, finished, capsys):
    record, out = finished
    path = str(next(out.rglob("metrics.json")))
    info = pytest.importorskip("sw_report.info", reason="has the command").info
    info.main([path, "--json"], standalone_mode=False)
    facts = json.loads(capsys.readouterr().out)
    assert facts["kind"] == "record"
    assert facts["phases"] == record.model_dump()["phases"]
    assert facts["metrics"]["psnr"] == record.metrics["psnr"].mean
    info.main([path], standalone_mode=False)
    text = capsys.readouterr().out
    for words in ("train: second", "pruner toy-pruner", "sw-helper 0.7", "rasterizer reference", "borrower"):
        assert words in text


def test_a_plan_says_whose_its_stages_and_tasks_are(helped_plugins, capsys):
    assert main(["schedule", "borrower"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "toy: 3 steps; of sw-toy 0.1"
    assert lines[1].split() == ["Stage", "|", "Task", "|", "Plan", "|", "From"]
    assert lines[3].split() == ["Pre", "|", "look", "|", "2", "|", "sw-helper"]
    assert lines[4] == "second: 8 steps"
    assert main(["schedule", "toy-taught"]) == 0
    text = capsys.readouterr().out
    assert "student: 8 steps; starts from a trained toy scene" in text
    assert "taught: 8 steps; taught by a trained toy scene" in text
    assert main(["schedule", "borrower", "--json"]) == 0
    first = json.loads(capsys.readouterr().out)["stages"][0]
    assert [part["distribution"] for part in first["provided_by"]] == ["sw-toy", "sw-helper"]
