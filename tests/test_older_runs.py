"""Run directories that version 0.1 left go on under this one: nothing is trained again, the model is the same.

tests/golden/runs_0_1 was made by 0.1.0: a finished run, and a training that was stopped after step 40 of 60. The files
are never rewritten.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from splatwizard_core.cli.main import main
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.identity import recorded_hash
from splatwizard_core.runs.record import read_record

GOLDEN = Path(__file__).parent / "golden" / "runs_0_1"


@pytest.fixture
def older(tmp_path):
    """older("finished") -> a copy of the run directory, and the root that it lies in."""

    def copy(name: str) -> tuple[Path, Path]:
        shutil.copytree(GOLDEN / name, tmp_path / name)
        return tmp_path / name / "demo-tiny" / "speedy-splat" / "r3", tmp_path / name

    return copy


def test_a_finished_run_is_not_trained_again_and_gives_the_same_model(older, capsys):
    directory, out = older("finished")
    before = json.loads((directory / "metrics.json").read_text())
    known = recorded_hash(load_plugins(), read_record(directory / "metrics.json"))
    checkpoints = {path.name: path.read_bytes() for path in (directory / "checkpoints").iterdir()}
    usual = [f"--set={key}=none" for key in ("principal_point", "mask_background")]  # 0.1 wrote what they came to
    assert main(["run", "--config", str(directory / "config.toml"), "--out", str(out), *usual]) == 0
    assert "training speedy-splat" not in capsys.readouterr().err
    after = json.loads((directory / "metrics.json").read_text())
    assert {path.name: path.read_bytes() for path in (directory / "checkpoints").iterdir()} == checkpoints
    assert after["file"]["digest"] == before["file"]["digest"]
    assert after["counts"] == before["counts"]
    assert after["train"]["train_s"] == before["train"]["train_s"]
    assert after["config_hash"] == known
    psnr = "metrics", "psnr", "mean"
    # Another CPU may round a pixel otherwise.
    assert _at(after, *psnr) == pytest.approx(_at(before, *psnr), abs=1e-3)


def test_the_file_of_a_finished_run_decodes_to_the_same_model(older, capsys):
    directory, _ = older("finished")
    digest = json.loads((directory / "metrics.json").read_text())["file"]["digest"]
    assert main(["decode", str(directory / "scene.swz"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["digest"] == digest


TRAINED = "eec54b0a1b1326139526ba3e517787cd4e5898c1fc726ad02570096dd51407e2"
"""Digest of the trained model, as 0.1.0 told it; the decoded one has its rows in the order of the file."""


def test_a_finished_run_is_measured_from_its_checkpoint(older, capsys):
    directory, _ = older("finished")
    before = json.loads((directory / "metrics.json").read_text())
    assert main(["eval", str(directory), "--no-speed", "--metrics", "psnr", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["digest"] == TRAINED
    assert _at(found, "metrics", "psnr", "mean") == pytest.approx(_at(before, "metrics", "psnr", "mean"), abs=1e-3)


def test_a_stopped_training_goes_on_from_its_checkpoint(older):
    directory, out = older("interrupted")
    before = (directory / "log.jsonl").read_text().splitlines()
    assert main(["train", "--config", str(directory / "config.toml"), "--out", str(out)]) == 0
    after = (directory / "log.jsonl").read_text().splitlines()
    assert after[: len(before)] == before  # what was done is not done again
    assert json.loads(after[-1])["step"] == 60
    assert [path.name for path in (directory / "checkpoints").glob("*.safetensors")] == ["00-0000060.safetensors"]


def _at(content, *names):
    for name in names:
        content = content[name]
    return content
