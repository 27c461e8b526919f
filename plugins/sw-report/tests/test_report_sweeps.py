"""The index of a sweep in a report: failures with their reasons, what is missing, and what is no index."""

import sqlite3
from contextlib import closing

import pytest
from sw_report.runs import collect
from sw_report.sweeps import FILE_NAME, sweep_notes

from splatwizard_core.errors import UserInputError


def write_index(folder, rows, *, schema="1"):
    with closing(sqlite3.connect(folder / FILE_NAME)) as file, file:
        file.execute("CREATE TABLE sweep (key TEXT, value TEXT)")
        file.execute("INSERT INTO sweep VALUES ('schema', ?)", (schema,))
        file.execute("CREATE TABLE runs (label, scene, seed, rate, directory, status, reason)")
        file.executemany("INSERT INTO runs VALUES (?, ?, ?, ?, ?, ?, ?)", rows)


def test_failures_and_what_is_missing_are_told(make_run, tmp_path):
    out = tmp_path / "sweep"
    make_run("r1", out=out / "seed-0")
    make_run("r2", out=out / "seed-0")
    here = "seed-0/garden/toy"
    write_index(out, [
        ("toy", "garden", 0, "r1", f"{here}/r1", "finished", ""),
        ("toy", "garden", 0, "r3", f"{here}/r3", "failed", "no memory\x1b[2J"),
        ("toy", "garden", 0, "r4", f"{here}/r4", "waiting", ""),
    ])  # fmt: skip
    notes = collect([out]).notes
    assert notes[0].startswith("failed: toy on garden, seed 0, r3: no memory")
    assert "\x1b" not in notes[0]
    assert notes[1:] == [
        f"1 of 3 runs of the sweep in {out} are not finished: `sw bench` goes on",
        f"1 runs in {out} are not of the plan of its sweep",
    ]
    assert collect([out / "seed-0"]).notes == []


def test_a_sweep_without_a_finished_run_goes_on_with_sw_bench(tmp_path):
    with pytest.raises(UserInputError, match=r"`sw run --out .*` makes them"):
        collect([tmp_path])
    write_index(tmp_path, [("toy", "x", 0, "r1", "x", "waiting", "")])
    with pytest.raises(UserInputError, match=f"`sw bench` goes on with the sweep in {tmp_path}"):
        collect([tmp_path])


def test_many_failures_are_counted(tmp_path):
    write_index(tmp_path, [("toy", "x", n, "r1", f"{n}", "failed", "why") for n in range(30)])
    notes = sweep_notes(tmp_path, [])
    assert len(notes) == 21
    assert notes[-1].startswith("10 more runs of the sweep")


@pytest.mark.parametrize(
    ("content", "told"),
    [(b"no database" * 100, "file is not a database"), (b"", "no such table: sweep")],
)
def test_what_is_no_index_is_told(make_run, tmp_path, content, told):
    make_run(out=tmp_path)
    (tmp_path / FILE_NAME).write_bytes(content)
    (note,) = collect([tmp_path]).notes
    assert told in note


def test_an_index_of_another_release_or_without_end_is_told(tmp_path):
    write_index(tmp_path, [], schema="2")
    assert "it is of another release" in sweep_notes(tmp_path, [])[0]
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as file, file:
        file.execute("UPDATE sweep SET value = '1'")
        file.execute("DROP TABLE runs")
        file.execute(
            "CREATE VIEW runs AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT '' AS label, "
            "'' AS scene, 0 AS seed, '' AS rate, '' AS directory, '' AS status, '' AS reason FROM n WHERE i < 0"
        )
    assert "interrupted" in sweep_notes(tmp_path, [])[0]
