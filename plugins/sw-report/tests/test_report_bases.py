"""Scenes that the methods of a table start from: steps with theirs, and a word where they were trained differently."""

from __future__ import annotations

from sw_report.exports import run_dict
from sw_report.results_tables import runs_table
from sw_report.runs import collect


def started(steps: int | None, config: dict | None = None, file: dict | None = None):
    scene = {"file": file or {}, "preset": None if file else "paper", "steps": steps, "train_s": None, "made_by": {},
             "config": None if file else {"iterations": steps, **(config or {})}}  # fmt: skip
    return lambda content: content["train"].update(steps=0, pretraining={"base": scene})


def trained(steps: int, codec: str = "exact"):
    def change(content):
        content["train"]["steps"] = steps
        content["config"]["config"] = {"iterations": steps, "codec": codec, "lr": {"means": 1e-3}}

    return change


def notes_and_steps(folder):
    table = runs_table(collect([folder]).runs)
    at = [column.name for column in table.columns].index("steps")
    notes = [note for note in table.notes if "trained differently" in note]
    return notes, {row.cells[0].text: row.cells[at].text for row in table.rows}


def test_steps_are_those_of_the_scene_that_a_method_starts_from_and_its_own(make_run, tmp_path):
    make_run(method="base", change=trained(300))
    make_run(method="codec", change=started(2000))
    notes, steps = notes_and_steps(tmp_path)
    assert steps == {"base": "300", "codec": "2,000 + 0"}
    assert notes == [
        "The base scenes of this table were trained differently, so compare with care: base: iterations 300; codec: "
        "iterations 2000."
    ]
    told = {run.variant: run_dict(run)["pretraining_steps"] for run in collect([tmp_path]).runs}
    assert told == {"base": {}, "codec": {"base": 2000}}


def test_equal_scenes_are_no_matter_however_they_are_encoded(make_run, tmp_path):
    make_run(method="base", change=trained(300, "exact"))
    make_run("r2", method="base", change=trained(300, "coarse"))
    make_run(method="codec", change=started(300, {"codec": "exact", "lr": {"means": 1e-3}}))
    assert notes_and_steps(tmp_path)[0] == []


def test_other_values_than_the_steps_are_named(make_run, tmp_path):
    make_run(method="base", change=trained(300))
    make_run(method="codec", change=started(300, {"lr": {"means": 2e-3}}))
    (note,) = notes_and_steps(tmp_path)[0]
    assert "base: lr.means 0.001; codec: lr.means 0.002" in note


def test_a_scene_from_a_file_is_another_one(make_run, tmp_path):
    make_run(method="codec", change=started(300))
    make_run(method="other", change=started(None, file={"name": "a.ply", "sha256": "00"}))
    notes, steps = notes_and_steps(tmp_path)
    assert steps == {"codec": "300 + 0", "other": "file + 0"}
    assert "other: file a.ply" in notes[0]
