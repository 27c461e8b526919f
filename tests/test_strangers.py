"""Packages that the workspace does not know, installed as wheels, through the ordinary `sw run`.

The example of a third party, and two small methods that hold the core to its contracts: a two-stage one (a borrowed
stage, a camera sampler of its own, a teacher, a learnable mask, a vector-quantised file) and an anchor method (an MLP
decoded per camera, statistics through extras, an entropy model driven by a context network in integers).
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from fresh_environments import ROOT, FreshEnvironment, build_wheel, make_environment

pytestmark = pytest.mark.pipeline

PACKAGES = {
    "opacity-prune": ROOT / "examples" / "sw-third-party",
    "test-distill": ROOT / "tests" / "plugins" / "sw-test-distill",
    "test-anchors": ROOT / "tests" / "plugins" / "sw-test-anchors",
}
SHORT = {
    "opacity-prune": ("base_iterations=40", "base_preset=paper", "iterations=10"),
    "test-distill": ("base_iterations=25", "iterations=25"),
    "test-anchors": ("iterations=50",),
}


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory, wheels) -> FreshEnvironment:
    """An environment with our wheels and the three foreign ones."""
    root = tmp_path_factory.mktemp("strangers")
    environment = make_environment(root / "env")
    built = [build_wheel(project, root) for project in PACKAGES.values()]
    environment.install(*wheels.values(), *built)
    return environment


def run(environment: FreshEnvironment, method: str, out: Path, *more: str) -> dict[str, object]:
    sets = [argument for pair in SHORT[method] for argument in ("--set", pair)]
    environment.run("run", "--method", method, "--scene", "demo", "--out", str(out), *sets, *more)
    (record,) = out.glob(f"**/{method}/**/metrics.json")
    return json.loads(record.read_text())


def test_they_are_listed_with_their_distribution(strangers):
    plugins = strangers.plugins()
    for method, project in PACKAGES.items():
        listed = plugins[project.name]
        assert listed["error"] is None
        assert [e["name"] for e in listed["provides"] if e["kind"] == "method"] == [method]


@pytest.mark.parametrize("method", PACKAGES)
def test_it_runs_by_name_and_its_file_decodes_in_a_fresh_process(strangers, tmp_path, method):
    record = run(strangers, method, tmp_path / "out")
    assert record["method"] == method
    (path,) = (tmp_path / "out").glob("**/scene.swz")
    assert record["file"]["bytes"] == path.stat().st_size == sum(record["file"]["sections"].values())
    assert math.isfinite(record["metrics"]["psnr"]["mean"])
    # The same file, nothing else, once more: the decoded model is the evaluated one.
    lonely = tmp_path / "lonely"
    lonely.mkdir()
    (lonely / "copy.swz").write_bytes(path.read_bytes())
    decoded = json.loads(strangers.run("decode", str(lonely / "copy.swz"), "--json").stdout)
    assert decoded["digest"] == record["file"]["digest"]


def test_the_plan_of_a_stranger_is_printed_stage_by_stage(strangers):
    text = strangers.run("schedule", "opacity-prune").stdout
    assert "prune and densify" in text
    assert "prune by opacity" in text
