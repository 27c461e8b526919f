"""`[[tasks]]`: a stranger's registered task in the plan of a method that knows nothing of it."""

import json
from pathlib import Path

import pytest
import torch

from splatwizard_core.base.lock import directory_lock
from splatwizard_core.cli.main import main
from splatwizard_core.errors import ConfigError
from splatwizard_core.runs.config import resolve
from splatwizard_core.runs.directory import RunRequest, run_directory
from splatwizard_core.runs.identity import training_key
from splatwizard_core.runs.pretrained import base_config, checked_start, planned_stages
from splatwizard_core.runs.run import train_in, train_only
from splatwizard_core.runs.session import Session
from splatwizard_core.training.scheduler import build_schedulers

DIM = """
[[tasks]]
name = "dim"
steps = "range(2, 6, 2)"
settings = {by = 0.25}
"""


def configured(plugins, folder: Path, text: str, method: str = "toy", sets=None):
    path = folder / "plan.toml"
    path.write_text(text)
    found = resolve(plugins.methods.load(method), config_file=path, sets=sets or {}, scene="demo:tiny", plugins=plugins)
    return checked_start(plugins, found)


def lines(plugins, resolved):
    return [line for stage in planned_stages(plugins, resolved) for s in build_schedulers(stage, resolved.ppl)
            for line in s.plan_lines()]  # fmt: skip


def test_a_strangers_task_is_in_the_plan_and_runs(helped_plugins, tmp_path):
    resolved = configured(helped_plugins, tmp_path, DIM)
    assert lines(helped_plugins, resolved) == ["post | dim | range(2, 6, 2) | priority 0"]
    session = Session(helped_plugins, torch.device("cpu"), lambda line: None)
    dimmed, directory = train_only(session, RunRequest(resolved, tmp_path / "a"))
    plain, _ = train_only(session, RunRequest(configured(helped_plugins, tmp_path, ""), tmp_path / "b"))
    expected = plain.model.opacity_logits.detach() - 2 * 0.25  # at steps 2 and 4; no stage of toy trains opacities
    torch.testing.assert_close(dimmed.model.opacity_logits.detach(), expected)
    logged = [json.loads(line) for line in (directory / "log.jsonl").read_text().splitlines()]
    assert [line["scalars"]["dimmed"] for line in logged if "scalars" in line] == [1.0, 2.0]
    assert ("task", "dim") in {(p.kind, p.name) for phase in dimmed.facts.phases for p in phase.provided_by}
    assert [task["task"] for task in dimmed.facts.plan[0].tasks] == ["dim"]


def test_what_it_keeps_survives_a_stop(helped_plugins, tmp_path):
    resolved = configured(helped_plugins, tmp_path, DIM)
    whole, _ = train_only(
        Session(helped_plugins, torch.device("cpu"), lambda line: None), RunRequest(resolved, tmp_path / "whole")
    )
    session = Session(helped_plugins, torch.device("cpu"), lambda line: None)
    request = RunRequest(resolved, tmp_path / "parts")
    directory = run_directory(request)
    with pytest.raises(KeyboardInterrupt), directory_lock(directory):
        train_in(session, request, directory, stop_after=3)
    again = Session(helped_plugins, torch.device("cpu"), lambda line: None)
    resumed, directory = train_only(again, request)
    assert resumed.model.digest() == whole.model.digest()
    logged = [json.loads(line) for line in (directory / "log.jsonl").read_text().splitlines()]
    assert [line["scalars"]["dimmed"] for line in logged if "scalars" in line] == [1.0, 2.0]


def test_it_is_in_the_identity_and_in_config_toml_but_not_in_what_is_started_from(helped_plugins, tmp_path):
    session = Session(helped_plugins, torch.device("cpu"), lambda line: None)
    other = DIM.replace("0.25", "0.5")
    found = [configured(helped_plugins, tmp_path, text) for text in ("", DIM, other)]
    assert len({training_key(session, each) for each in found}) == 3
    assert len({each.config_hash() for each in found}) == 3
    again = configured(helped_plugins, tmp_path, found[1].toml())
    assert again.ppl.tasks == found[1].ppl.tasks
    assert training_key(session, again) == training_key(session, found[1])
    student = configured(helped_plugins, tmp_path, DIM, "toy-student")
    assert base_config(helped_plugins, "toy", student).ppl.tasks == []


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (('"dim"', '"dimm"'), "no task is called 'dimm'; did you mean 'dim'?"),
        (("by =", "bye ="), "unknown key 'bye' in tasks, 1. 'dim': did you mean 'by'?"),
        (("0.25", '"much"'), "bad value 'much' for 'by' in tasks, 1. 'dim': expected a number"),
        (("0.25", "[1]"), "bad value [1] for 'by' in tasks, 1. 'dim': must be a valid number"),
        (("0.25", "-1"), "by is -1.0: it must be at least 0"),
        (("range(2, 6, 2)", "every 2"), "'every 2' is neither a step, a list of steps, nor range(first, end, every)"),
        (('"range(2, 6, 2)"', "[2, -4]"), "steps: step -4 is negative"),
        (("steps", "stpes"), "unknown key 'stpes' of [[tasks]]: did you mean 'steps'?"),
        (('name = "dim"', 'name = "dim"\nstage = "toi"'), "no stage is called 'toi': did you mean 'toy'?"),
        (('"dim"', '"look"'), "it has no settings: leave them out"),
    ],
)
def test_what_is_wrong_is_told_before_anything_runs(helped_plugins, tmp_path, change, told):
    assert change[0] in DIM
    with pytest.raises(ConfigError) as error:
        configured(helped_plugins, tmp_path, DIM.replace(*change))
    assert told in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_the_schedule_shows_it_with_its_package(helped_plugins, tmp_path, capsys):
    (tmp_path / "plan.toml").write_text(DIM + "before_render = true\npriority = -1\n")
    assert main(["schedule", "toy", "--config", str(tmp_path / "plan.toml")]) == 0
    assert "Pre   | dim  | range(2, 6, 2) | sw-helper" in capsys.readouterr().out
