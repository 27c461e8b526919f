"""What makes finished work count as finished: what pictures and files hold, and the versions that made it."""

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from forked_children import start_python
from PIL import Image
from pydantic import Field

from splatwizard_core.cli.main import main
from splatwizard_core.errors import CheckpointError, SceneError
from splatwizard_core.method import Method
from splatwizard_core.plugins import PluginManager
from splatwizard_core.plugins.versions import changes, installed
from splatwizard_core.runs import run as run_module
from splatwizard_core.runs.config import parse_set, read_config_file, resolve
from splatwizard_core.runs.directory import RunRequest, StepLog, run_directory
from splatwizard_core.runs.facts import EncodingFacts, TrainingFacts
from splatwizard_core.runs.run import run, train_only
from splatwizard_core.runs.session import Session
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.digest import digests_of, picture_files, scene_digest
from splatwizard_core.scene.loading import load_scene
from splatwizard_core.training.keys import input_files
from splatwizard_core.training.params import InputFile, OptimizationParams, Params

pytestmark = pytest.mark.pipeline


class Invocation:
    """One command: a session, and what it said."""

    def __init__(self, plugins: PluginManager, out: Path, scene: str = "demo:tiny") -> None:
        self.plugins, self.out, self.scene = plugins, out, scene
        self.said: list[str] = []
        self.session = Session(plugins, torch.device("cpu"), self.said.append)

    def request(self, *sets: str, rate: str | None = None) -> RunRequest:
        resolved = resolve(
            self.plugins.methods.load("toy"), rate=rate, sets=parse_set(["iterations=2", *sets]), scene=self.scene
        )
        return RunRequest(resolved, self.out)


@pytest.fixture
def photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """The tiny demo scene as a COLMAP folder."""
    folder = tmp_path / "photographs"
    assert main(["data", "synth", str(folder), "--size", "tiny"]) == 0
    capsys.readouterr()
    return folder


def repaint(picture: Path) -> None:
    """Another picture of the same size at the same path, and nothing tells but what it holds."""
    before = picture.stat()
    with Image.open(picture) as opened:
        size = opened.size
    Image.new("RGB", size, (10, 200, 30)).save(picture)
    os.utime(picture, ns=(before.st_atime_ns, before.st_mtime_ns))


def pictures(folder: Path) -> list[Path]:
    return sorted((folder / "images").iterdir())


def test_the_digest_follows_every_picture_and_nothing_else(photographs: Path, toy_plugins: PluginManager):
    def digest() -> str:
        return scene_digest(load_scene(str(photographs), SceneOptions(), toy_plugins))

    first = digest()
    (photographs / "notes.txt").write_text("holiday")
    for picture in pictures(photographs):
        os.utime(picture, (0, 0))
    assert digest() == first
    seen = {first}
    for picture in pictures(photographs):  # those that are tested too
        repaint(picture)
        seen.add(digest())
    assert len(seen) == 1 + len(pictures(photographs))


def test_loaders_tell_the_files_of_their_views(photographs: Path, toy_plugins: PluginManager):
    scene = load_scene(str(photographs), SceneOptions(), toy_plugins)
    views = [*scene.train, *scene.test]
    assert sorted(f for view in views for f in picture_files(view)) == pictures(photographs)
    drawn = load_scene("demo:tiny", SceneOptions(), toy_plugins)
    assert [picture_files(view) for view in drawn.train] == [[]] * len(drawn.train)


def test_pictures_of_a_loader_that_tells_no_files_count_by_their_pixels(photographs: Path, toy_plugins: PluginManager):
    def digest(repainted: int | None) -> str:
        scene = load_scene(str(photographs), SceneOptions(), toy_plugins)
        for i, view in enumerate([*scene.train, *scene.test]):
            pixels = view.pixels if i != repainted else view.pixels // 2
            view.load = lambda pixels=pixels: pixels.permute(1, 2, 0).numpy()
            view.__dict__.pop("pixels")
        return scene_digest(scene)

    count = len(pictures(photographs))
    assert len({digest(i) for i in (None, *range(count))}) == 1 + count


def test_a_picture_that_is_gone_is_a_scene_error(tmp_path: Path):
    with pytest.raises(SceneError, match=r"absent.png: cannot be read"):
        digests_of([tmp_path / "absent.png"])


def test_changed_pictures_do_not_count_as_finished(photographs: Path, toy_plugins: PluginManager, tmp_path: Path):
    first = Invocation(toy_plugins, tmp_path / "out", str(photographs))
    train_only(first.session, first.request())
    again = Invocation(toy_plugins, tmp_path / "out", str(photographs))
    train_only(again.session, again.request())
    assert not any("training" in line for line in again.said)
    repaint(pictures(photographs)[0])  # a test view
    changed = Invocation(toy_plugins, tmp_path / "out", str(photographs))
    with pytest.raises(CheckpointError, match=r"scene content: \w+\.\.\. -> \w+\.\.\.\): .*use --fresh"):
        train_only(changed.session, changed.request())
    _, directory = train_only(changed.session, replace(changed.request(), resume=False))
    assert json.loads((directory / "steps.json").read_text())["train"]["facts"]["steps"] == 2


class StopError(Exception):
    pass


@pytest.fixture
def only_encode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs end where they would start other processes."""

    def stop(*_: object, **__: object) -> None:
        raise StopError

    monkeypatch.setattr(run_module, "decode_fresh", stop)
    monkeypatch.setattr(run_module, "run_fresh", stop)


def encode_step(plugins: PluginManager, out: Path) -> list[str]:
    """What a run says up to its decoding."""
    invocation = Invocation(plugins, out)
    with pytest.raises(StopError):
        run(invocation.session, invocation.request())
    return invocation.said


def test_a_new_version_of_a_plugin_encodes_again(
    toy_plugins: PluginManager, tmp_path: Path, only_encode: None, monkeypatch: pytest.MonkeyPatch
):
    assert any(line.startswith("encoded") for line in encode_step(toy_plugins, tmp_path))
    assert encode_step(toy_plugins, tmp_path) == []
    info = next(p for p in toy_plugins.plugins if p.distribution == "sw-toy")
    monkeypatch.setattr(info, "version", "0.2")
    told = encode_step(toy_plugins, tmp_path)
    assert any("scene.swz was made with sw-toy 0.1, now 0.2: encoding again" in line for line in told)
    assert any("was trained with sw-toy 0.1, now 0.2; it is used as it is (--fresh trains again)" in x for x in told)
    assert any(line.startswith("encoded") for line in told)
    assert encode_step(toy_plugins, tmp_path) == []


def test_every_key_after_encoding_holds_the_versions(
    toy_plugins: PluginManager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    invocation = Invocation(toy_plugins, tmp_path)
    request = invocation.request()

    def keys() -> set[str]:
        made_by = installed(toy_plugins, ["sw-toy"])
        facts = EncodingFacts(encode_s=0.0, bytes=1, sha256="0", made_by=made_by)
        return set(run_module.step_keys(invocation.session, request.resolved, facts).values())

    before = keys()
    assert keys() == before
    info = next(p for p in toy_plugins.plugins if p.distribution == "sw-toy")
    monkeypatch.setattr(info, "version", "0.2")
    assert not keys() & before


def test_changes_name_what_is_another_version_or_gone(toy_plugins: PluginManager):
    now = installed(toy_plugins, ["sw-toy"])
    assert changes(toy_plugins, now) == []
    assert changes(toy_plugins, {**now, "sw-gone": "1.0"}) == ["sw-gone 1.0, now not installed"]


def test_a_shared_training_that_was_removed_is_made_again(toy_plugins: PluginManager, tmp_path: Path):
    first = Invocation(toy_plugins, tmp_path)
    expected, home = train_only(first.session, first.request(rate="r1"))
    _, sharing = train_only(first.session, first.request(rate="r2"))
    assert not (sharing / "checkpoints").exists()
    shutil.rmtree(home)
    again = Invocation(toy_plugins, tmp_path)
    found, _ = train_only(again.session, again.request(rate="r2"))
    assert found.model.digest() == expected.model.digest()
    assert found.facts.trained_in == "r2"
    assert StepLog(sharing).done("train", found.key, TrainingFacts).trained_in == "r2"


class Start(Params):
    file: InputFile = Field("", description="points to start from")


class ConfigWithFiles(OptimizationParams):
    start: Start = Start()
    other: InputFile = Field("", description="something else")
    name: str = Field("", description="no file")


class WithFiles(Method):
    name = "with-files"
    Config = ConfigWithFiles

    def stages(self) -> Sequence[Any]:
        return []


def training_hash(**values: str) -> str:
    return resolve(WithFiles, sets=values, scene="demo:tiny").training_hash()


def test_input_files_count_by_what_they_hold(tmp_path: Path):
    assert input_files(ConfigWithFiles) == ["start.file", "other"]
    a, b = tmp_path / "a.ply", tmp_path / "b.ply"
    a.write_bytes(b"one")
    b.write_bytes(b"one")
    first = training_hash(**{"start.file": str(a)})
    assert first == training_hash(**{"start.file": str(b)}) != training_hash()
    assert first != training_hash(other=str(a))
    a.write_bytes(b"two")
    assert first != training_hash(**{"start.file": str(a)})
    assert training_hash(name=str(a)) != training_hash(name=str(b)), "a name that is no file counts as it is"


def test_a_config_file_finds_its_input_files_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "a.ply").write_bytes(b"one")
    monkeypatch.chdir(tmp_path)
    written = resolve(WithFiles, sets={"start.file": "a.ply"}, scene="demo:tiny")
    (tmp_path / "config.toml").write_text(written.toml())
    assert read_config_file(tmp_path / "config.toml")["start"]["file"] == str(tmp_path / "a.ply")


def test_a_child_ends_with_the_process_that_started_it(toy_plugins: PluginManager, tmp_path: Path):
    """Else it would go on writing where the next run writes."""
    arguments = [
        "train",
        "--method",
        "toy",
        "--scene",
        "demo:tiny",
        "--set",
        "iterations=1000000",
        "--out",
        str(tmp_path),
    ]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    child = start_python("-m", "splatwizard_core.cli.fresh_child", *arguments, **pipes)
    assert child.stdin is not None
    assert child.stderr is not None
    assert any(b"training toy" in line for line in child.stderr)  # a slow machine tells of other things first
    assert child.poll() is None
    child.stdin.close()
    assert child.wait() == 1


def test_identity_and_run_directory_stay_what_they_are(toy_plugins: PluginManager, tmp_path: Path):
    """Two digests of one drawn scene are equal, and the directory is named by scene, method and rate."""
    scenes = [load_scene("demo:tiny", SceneOptions(), toy_plugins) for _ in range(2)]
    assert len({scene_digest(scene) for scene in scenes}) == 1
    assert run_directory(Invocation(toy_plugins, tmp_path).request()) == tmp_path / "demo-tiny" / "toy" / "r2"
