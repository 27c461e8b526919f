"""A command that looks at a file on a scene takes the scene of the file's own run directory, or none."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import click
import pytest
from sw_bench.running import plan_of_options
from sw_gaussians.ply import export_ply
from sw_gaussians.start import gaussians_from_points

from splatwizard_core import steps as api
from splatwizard_core.api import UserInputError
from splatwizard_core.cli.main import main
from splatwizard_core.cli.setup import Choices
from splatwizard_core.plugins import load_plugins

GOLDEN = Path(__file__).parent / "golden"
FINISHED = GOLDEN / "runs_0_1" / "finished" / "demo-tiny" / "speedy-splat" / "r3"
STRAY = str(GOLDEN / "speedy_splat_r3_v1.swz")


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a finished run on demo:tiny, that was read with a white background."""
    shutil.copytree(FINISHED, tmp_path / "r3")
    config = tmp_path / "r3" / "config.toml"
    text = config.read_text()
    assert 'background = "none"' in text
    config.write_text(text.replace('background = "none"', 'background = "white"'))
    return tmp_path / "r3"


def test_a_file_in_a_run_directory_is_measured_on_the_scene_of_the_run_as_it_was_read(run: Path, capsys):
    assert main(["eval", str(run / "scene.swz"), "--no-speed", "--metrics", "psnr", "--json"]) == 0
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert found["scene"] == "demo-tiny"
    assert "/white/" in found["protocol"]["id"]
    assert f"scene demo:tiny, as in the run directory that {run / 'scene.swz'} lies in" in captured.err


def test_a_named_scene_is_taken_as_it_is(run: Path, capsys):
    given = ["eval", str(run / "scene.swz"), "--scene", "demo:tiny", "--no-speed", "--metrics", "psnr", "--json"]
    assert main(given) == 0
    captured = capsys.readouterr()
    assert "/black/" in json.loads(captured.out)["protocol"]["id"]
    assert "run directory" not in captured.err


def test_another_scene_than_that_of_the_run_is_told(run: Path, capsys):
    Choices(scene="demo").of_file(run / "scene.swz")
    assert "lies in a run directory of scene demo:tiny, and is looked at on demo" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command",
    [
        ["eval", "{file}"], ["render", "{file}", "--out", "{folder}/views"], ["bake", "{file}", "{folder}/out.ply"],
        ["mesh", "{file}", "--out", "{folder}/mesh"], ["run", "--method", "spz", "--init", "{file}"],
        ["train", "--method", "lightgaussian", "--init", "{file}"],
        ["run", "--method", "lightgaussian", "--set", "init={file}"],
        ["bench", "--method", "spz", "--seed", "0,1", "--init", "{file}"],
    ],
    ids=lambda words: " ".join(words[:2]),
)  # fmt: skip
def test_a_file_that_nothing_is_known_of_is_not_put_on_a_default_scene(command, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photo.ply").touch()
    told = [word.format(file=tmp_path / "photo.ply", folder=tmp_path) for word in command]
    assert main(told) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "nothing says which scene" in line
    assert "--scene" in line
    assert [path.name for path in tmp_path.iterdir()] == ["photo.ply"]


def test_from_python_it_is_the_same(run: Path, tmp_path: Path):
    found = api.evaluate(run / "scene.swz")
    assert "/white/" in found["protocol"]["id"]
    shutil.copy(run / "scene.swz", tmp_path / "stray.swz")
    with pytest.raises(UserInputError, match="nothing says which scene"):
        api.evaluate(tmp_path / "stray.swz")


def test_a_config_of_another_program_names_no_scene(tmp_path: Path):
    (tmp_path / "config.toml").write_text("colour = 'red'\n")
    with pytest.raises(UserInputError, match="nothing says which scene"):
        Choices().of_file(tmp_path / "a.ply")


def test_a_training_takes_the_scene_of_what_it_starts_from_and_nothing_else_of_that_run(run: Path):
    told: list[str] = []
    start = run / "start.ply"
    start.touch()
    chosen = Choices(methods=("spz",), init=str(start)).of_start(told.append)
    assert chosen.scene == "demo:tiny"
    assert chosen.config_file is None
    assert told[0].startswith("scene demo:tiny, that of the run directory")


def test_a_sweep_without_a_scene_is_about_that_of_its_start(run: Path, tmp_path: Path):
    start = run / "start.ply"
    start.touch()
    context = click.Context(load_plugins().commands.load("bench"))
    words = ["--method", "spz", "--seed", "0,1", "--init", str(start), "--out", str(tmp_path / "out")]
    given = context.command.make_context("bench", words).params
    given.pop("paths"), given.pop("train_shared")
    assert plan_of_options(None, given).plan.scenes == ("demo:tiny",)


def test_a_training_from_a_file_of_gaussians_tells_what_it_starts_from(tmp_path: Path, capsys):
    start = tmp_path / "start.ply"
    export_ply(gaussians_from_points(api.load_scene("demo:tiny").points), start)
    words = ["train", "--method", "3dgs", "--scene", "demo:tiny", "--set", "iterations=1", "--out", str(tmp_path)]
    assert main([*words, "--init", str(start)]) == 0
    assert f"from {start} in place of the scene's points" in capsys.readouterr().err
    assert main(words) == 2  # another training
    assert main([*words, "--fresh"]) == 0
    assert "in place of" not in capsys.readouterr().err


def test_what_a_run_was_read_with_is_no_warning_when_it_is_measured_again(run: Path, capsys):
    config = run / "config.toml"
    config.write_text(config.read_text().replace('principal_point = "none"', 'principal_point = "file"'))
    words = ["--no-speed", "--metrics", "psnr", "--json"]
    for told, given in (
        (False, ["eval", str(run / "scene.swz"), *words]),
        (True, ["eval", str(run / "scene.swz"), *words, "--set", "principal_point=file"]),
        (True, ["eval", str(run / "scene.swz"), *words, "--set", "mask_background=true"]),
    ):
        assert main(given) == 0
        assert ("is of no use" in capsys.readouterr().err) == told
