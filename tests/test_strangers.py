"""Packages that the workspace does not know, installed as wheels, through the ordinary `sw run`.

The example of a third party, and two small methods that hold the core to its contracts: a two-stage one (a borrowed
stage, a camera sampler of its own, a teacher, a learnable mask, a vector-quantised file) and an anchor method (an MLP
decoded per camera, statistics through extras, an entropy model driven by a context network in integers).
"""

from __future__ import annotations

import json
import math
import signal
import time
import zipfile
from pathlib import Path
from typing import Any

import pytest
from fresh_environments import ROOT, build_wheels
from strangers_site import Site

pytestmark = pytest.mark.pipeline

PACKAGES = {
    "opacity-prune": ROOT / "examples" / "sw-third-party",
    "test-distill": ROOT / "tests" / "plugins" / "sw-test-distill",
    "test-anchors": ROOT / "tests" / "plugins" / "sw-test-anchors",
}
SHORT = {
    "opacity-prune": ("pretrained.iterations=40", "iterations=10"),
    "test-distill": ("base_iterations=25", "iterations=25"),
    # The opacity that keeps an anchor is raised, or none of them would have gone after so few steps.
    "test-anchors": ("iterations=50", "min_opacity=0.99", "log_every=1"),
}
STEPS = 30
INTERRUPTED = {
    "test-distill": (1, ("base_iterations=10", f"iterations={STEPS}", "log_every=1")),
    "test-anchors": (0, (f"iterations={STEPS}", "adjust_interval=10", "grad_threshold=5e-3", "log_every=1")),
}
"""The stage that is interrupted, and a run so long that the interrupt nearly always comes in the middle of a step."""
BRAKE = f"""
import os, time
from splatwizard_core.api import hookimpl

class Brake:
    def after_step(self, model, record):
        if record.step == {STEPS} - 5:
            time.sleep(3600)

    def finished(self):
        pass

@hookimpl
def run_started(training):
    return Brake() if "TEST_BRAKE" in os.environ else None
"""
"""A plugin that stops a training shortly before its end until it is interrupted: however late that comes, it comes."""


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """The three foreign wheels, unpacked as pip does, and the brake."""
    site = Site(tmp_path_factory.mktemp("strangers"))
    for wheel in build_wheels(list(PACKAGES.values()), tmp_path_factory.mktemp("wheels")):
        with zipfile.ZipFile(wheel) as content:
            content.extractall(site.folder)
    site.install("sw-brake", BRAKE)
    return site


def arguments(method: str, out: Path, sets: tuple[str, ...]) -> list[str]:
    pairs = [argument for pair in sets for argument in ("--set", pair)]
    return ["--method", method, "--scene", "demo:tiny", "--out", str(out), *pairs]


def record_of(out: Path) -> dict[str, Any]:
    (record,) = out.glob("**/metrics.json")
    return json.loads(record.read_text())


def log_of(out: Path) -> list[dict[str, Any]]:
    """The lines of log.jsonl; a run that writes it may be in the middle of the last one."""
    text = "".join(path.read_text() for path in out.glob("**/log.jsonl"))
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def test_they_are_listed_with_their_distribution(strangers):
    plugins = strangers.listed()
    for method, project in PACKAGES.items():
        listed = plugins.of(project.name)
        assert listed["error"] is None
        assert [e["name"] for e in listed["provides"] if e["kind"] == "method"] == [method]


@pytest.mark.parametrize("method", PACKAGES)
def test_it_runs_by_name_and_its_file_decodes_in_a_fresh_process(strangers, tmp_path, method):
    strangers.sw("run", *arguments(method, tmp_path / "out", SHORT[method]))
    record = record_of(tmp_path / "out")
    assert record["method"] == method
    (path,) = (tmp_path / "out").glob("**/scene.swz")
    assert record["file"]["bytes"] == path.stat().st_size == sum(record["file"]["sections"].values())
    assert math.isfinite(record["metrics"]["psnr"]["mean"])
    # The same file, nothing else, once more: the decoded model is the evaluated one.
    lonely = tmp_path / "lonely"
    lonely.mkdir()
    (lonely / "copy.swz").write_bytes(path.read_bytes())
    decoded = json.loads(strangers.sw("decode", str(lonely / "copy.swz"), "--json").stdout)
    assert decoded["digest"] == record["file"]["digest"]
    if method == "test-anchors":
        rows = [line["num_anchors"] for line in log_of(tmp_path / "out") if "num_anchors" in line]
        assert rows[0] != rows[-1] == record["counts"]["num_anchors"]


@pytest.mark.parametrize("method", INTERRUPTED)
def test_an_interrupted_training_goes_on_and_ends_as_an_uninterrupted_one(strangers, tmp_path, method):
    stage, sets = INTERRUPTED[method]
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    strangers.sw("train", *arguments(method, whole, sets))
    with strangers.start("train", *arguments(method, broken, sets), TEST_BRAKE="1") as process:
        while process.poll() is None and not any(x["stage"] == stage and x["step"] > 12 for x in log_of(broken)):
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        _, told = process.communicate()
    assert process.returncode == 130, told
    last = log_of(broken)[-1]
    assert (last["stage"], last["step"] < STEPS) == (stage, True)
    assert list(broken.glob(f"**/checkpoints/{stage:02}-{last['step']:07}.safetensors"))
    strangers.sw("train", *arguments(method, broken, sets))
    assert log_of(broken)[-1]["step"] == STEPS
    files = []
    for out in (whole, broken):
        (directory,) = (path.parent for path in out.glob("**/config.toml"))
        strangers.sw("encode", str(directory))
        files.append((directory / "scene.swz").read_bytes())
    assert files[0] == files[1]


def test_the_plan_of_a_stranger_is_printed_stage_by_stage(strangers):
    text = strangers.sw("schedule", "opacity-prune").stdout
    assert "starts from a trained 3dgs scene" in text
    assert "prune by opacity" in text
