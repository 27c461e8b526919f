"""Observers of a training: each is told of every step, changes nothing, and can fail alone."""

import random
from types import SimpleNamespace

import pytest
import torch

from splatwizard_core.plugins import PluginManager
from splatwizard_core.runs.config import parse_set, resolve
from splatwizard_core.runs.directory import RunRequest
from splatwizard_core.runs.observers import watched_by
from splatwizard_core.runs.run import train_in, train_only
from splatwizard_core.runs.session import Session

pytestmark = pytest.mark.pipeline


class Run:
    """One invocation: a session, and what it said."""

    def __init__(self, plugins: PluginManager, out, *sets: str) -> None:
        self.said: list[str] = []
        self.session = Session(plugins, torch.device("cpu"), self.said.append)
        resolved = resolve(plugins.methods.load("toy"), sets=parse_set(sets), scene="demo:tiny")
        self.request = RunRequest(resolved, out)

    def train(self):
        return train_only(self.session, self.request)[0]


@pytest.fixture
def watched(helped_plugins: PluginManager, monkeypatch: pytest.MonkeyPatch):
    """The module of a plugin that watches trainings, with its notes cleared."""
    import toy_helper

    toy_helper.NOTES.clear()
    monkeypatch.setattr(toy_helper, "WATCH", True)
    return toy_helper


def test_an_observer_sees_every_step_and_changes_nothing(helped_plugins, watched, tmp_path, monkeypatch):
    found = Run(helped_plugins, tmp_path / "watched").train()
    assert ["started toy r2 demo-tiny", *(f"step {i} of 60" for i in range(1, 7)), "finished"] == watched.NOTES
    monkeypatch.setattr(watched, "WATCH", False)
    assert Run(helped_plugins, tmp_path / "alone").train().model.digest() == found.model.digest()


def test_a_training_that_is_only_loaded_is_not_watched(helped_plugins, watched, tmp_path):
    Run(helped_plugins, tmp_path).train()
    watched.NOTES.clear()
    Run(helped_plugins, tmp_path).train()
    assert watched.NOTES == []


def test_an_interrupted_training_is_finished_for_its_observer(helped_plugins, watched, tmp_path):
    run = Run(helped_plugins, tmp_path)
    directory = tmp_path / "here"
    directory.mkdir()
    with pytest.raises(KeyboardInterrupt):
        train_in(run.session, run.request, directory, stop_after=2)
    assert watched.NOTES[-2:] == ["step 2 of 60", "finished"]


def test_an_observer_that_raises_is_told_with_its_package_and_dropped(helped_plugins, watched, tmp_path, monkeypatch):
    monkeypatch.setattr(watched, "FAILS_AT", 3)
    run = Run(helped_plugins, tmp_path)
    assert run.train().facts.steps == 6
    assert watched.NOTES[-2:] == ["step 2 of 60", "finished"]
    warnings = [line for line in run.said if line.startswith("warning")]
    assert warnings == ["warning: observer Watcher of sw-helper 0.7 is dropped: OSError: no screen"]


def test_those_who_do_not_watch_are_left_out(helped_plugins):
    with watched_by([None, None], helped_plugins, print) as after_step:
        assert after_step is None
    told = []
    observer = SimpleNamespace(after_step=lambda *_: random.random(), finished=lambda: told.append("finished"))
    with watched_by([None, observer], helped_plugins, print) as after_step:
        assert after_step is not None
    assert told == ["finished"]
