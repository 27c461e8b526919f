"""Finished trainings stay found when keys come, and when a release tells them apart in another way."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from pydantic import create_model

from splatwizard_core.base.lock import directory_lock
from splatwizard_core.errors import CheckpointError
from splatwizard_core.plugins import PluginManager
from splatwizard_core.runs.config import ResolvedConfig, parse_set, resolve
from splatwizard_core.runs.directory import CHECKPOINTS, STEPS, RunRequest
from splatwizard_core.runs.identity import key_when_made
from splatwizard_core.runs.pretrained import base_config
from splatwizard_core.runs.run import train_only
from splatwizard_core.runs.session import Session
from splatwizard_core.runs.training import CACHE, cached_directory, train, trained_scene
from splatwizard_core.training.checkpoint import CheckpointStore, read_checkpoint

pytestmark = pytest.mark.pipeline


class Command:
    """One command: a session, and what it said."""

    def __init__(self, plugins: PluginManager, out: Path) -> None:
        self.plugins, self.out = plugins, out
        self.said: list[str] = []
        self.session = Session(plugins, torch.device("cpu"), self.said.append)

    def resolved(self, *sets: str, method: str = "toy-student") -> ResolvedConfig:
        return resolve(self.plugins.methods.load(method), sets=parse_set(sets), scene="demo:tiny")

    def train(self, *sets: str, method: str = "toy-student") -> Path:
        return train_only(self.session, RunRequest(self.resolved(*sets, method=method), self.out))[1]

    @property
    def trained(self) -> list[str]:
        """Methods that were trained."""
        return [line.split()[1] for line in self.said if line.startswith("training ")]


def older(directory: Path) -> str:
    """Make a run directory one of release 0.2, which hashed every value; returns its key."""
    store = CheckpointStore(directory / CHECKPOINTS, keep=9)
    for path in reversed(store.paths()):
        found = read_checkpoint(path)
        found.identity.pop("key")
        found.identity["identity"] = 2
        store.write(found)
    key = key_when_made(store.identity() or {})
    steps = json.loads((directory / STEPS).read_text())
    (directory / STEPS).write_text(json.dumps({name: {**step, "key": key} for name, step in steps.items()}))
    return key


def older_cache(out: Path) -> Path:
    """Make the one cached scene one of release 0.2; returns its folder."""
    (folder,) = (out / CACHE).iterdir()
    return folder.rename(folder.with_name(f"{folder.name[:-16]}{older(folder)[:16]}"))


def with_new_key(patch: pytest.MonkeyPatch, plugins: PluginManager, **class_attributes: Any) -> None:
    """Give the toy methods a key more than they had."""
    for name in ("toy", "toy-student"):
        cls = plugins.methods.load(name)
        fields: dict[str, Any] = {"new_key": (int, 0)}
        larger = create_model("Larger", __base__=cls.Config, **fields)
        for attribute, value in class_attributes.items():
            setattr(larger, attribute, value)
        patch.setattr(cls, "Config", larger)


def test_a_new_key_keeps_every_training_and_cached_scene(
    toy_plugins: PluginManager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    first = Command(toy_plugins, tmp_path)
    first.train()
    assert first.trained == ["toy-student", "toy"]
    with_new_key(monkeypatch, toy_plugins)
    again = Command(toy_plugins, tmp_path)
    again.train()
    assert again.trained == []
    other = Command(toy_plugins, tmp_path)
    other.out.joinpath("demo-tiny").rename(tmp_path / "before")  # the student trains, its start is in the cache
    other.train()
    assert other.trained == ["toy-student"]
    used = Command(toy_plugins, tmp_path)
    with pytest.raises(CheckpointError, match=r"config\.new_key: 0 -> 1"):
        used.train("new_key=1")


def test_a_changed_default_that_is_counted_trains_again(
    toy_plugins: PluginManager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    Command(toy_plugins, tmp_path).train(method="toy")
    with_new_key(monkeypatch, toy_plugins, DEFAULTS=1)
    fields: dict[str, Any] = {"iterations": (int, 7)}
    for name in ("toy", "toy-student"):
        cls = toy_plugins.methods.load(name)
        monkeypatch.setattr(cls, "Config", create_model("Changed", __base__=cls.Config, **fields))
        monkeypatch.setattr(cls, "PRESETS", {"paper": {}, "quick": {}})
    changed = Command(toy_plugins, tmp_path)
    with pytest.raises(CheckpointError, match=r"config\.iterations: 6 -> 7"):
        changed.train(method="toy")
    as_before = Command(toy_plugins, tmp_path)
    as_before.train("iterations=6", method="toy")
    assert as_before.trained == []


def test_finished_trainings_of_an_older_release_are_used_where_they_lie(toy_plugins: PluginManager, tmp_path: Path):
    directory = Command(toy_plugins, tmp_path).train()
    older(directory)
    before = (directory / STEPS).read_bytes()
    older_cache(tmp_path)
    again = Command(toy_plugins, tmp_path)
    assert again.train() == directory
    assert again.trained == []
    assert (directory / STEPS).read_bytes() == before
    other = Command(toy_plugins, tmp_path)
    with pytest.raises(CheckpointError, match=r"config\.iterations: \d+ -> 3;? ?"):
        other.train("iterations=3")
    directory.rename(tmp_path / "before")
    student = Command(toy_plugins, tmp_path)
    student.train("iterations=3")
    assert student.trained == ["toy-student"]
    assert len(list((tmp_path / CACHE).iterdir())) == 1


def test_a_scene_that_an_older_release_began_is_gone_on_with(toy_plugins: PluginManager, tmp_path: Path):
    first = Command(toy_plugins, tmp_path)
    base = base_config(toy_plugins, "toy", first.resolved())
    directory = cached_directory(first.session, base, tmp_path)
    with pytest.raises(KeyboardInterrupt), directory_lock(directory):
        train(first.session, RunRequest(base, tmp_path), directory, stop_after=2)
    folder = older_cache(tmp_path)
    again = Command(toy_plugins, tmp_path)
    found = trained_scene(again.session, "toy", again.resolved(), tmp_path)
    assert any("is not finished yet: going on with it first" in line for line in again.said)
    assert found.facts.steps == 6
    assert list((tmp_path / CACHE).iterdir()) == [folder]


def test_a_training_whose_steps_and_checkpoint_do_not_belong_together_is_not_taken(
    toy_plugins: PluginManager, tmp_path: Path
):
    directory = Command(toy_plugins, tmp_path).train(method="toy")
    older(directory)
    steps = json.loads((directory / STEPS).read_text())
    steps["train"]["key"] = "0" * 64
    (directory / STEPS).write_text(json.dumps(steps))
    again = Command(toy_plugins, tmp_path)
    again.train(method="toy")
    assert again.trained == ["toy"]  # its checkpoint is of the last step: nothing is left to do
