"""Finding runs, naming them apart, and saying what keeps them from being compared."""

import shutil

import pytest
from sw_report.runs import collect, natural

from splatwizard_core.errors import UserInputError


def test_runs_are_found_at_any_depth_once_and_in_order(make_run, tmp_path):
    for scene, method, rate, size in (
        ("scan10", "toy", "r1", 9), ("scan9", "toy", "r2", 5), ("scan9", "toy", "r1", 7), ("scan9", "hac", "r1", 8),
    ):  # fmt: skip
        make_run(rate, scene=scene, method=method, size=size * 1000)
    found = collect([tmp_path, tmp_path / "out" / "scan9"]).runs
    assert [(r.facts.scene, r.label) for r in found] == [
        ("scan9", "hac r1"), ("scan9", "toy r1"), ("scan9", "toy r2"), ("scan10", "toy r1"),
    ]  # fmt: skip


def test_a_run_directory_and_its_record_are_arguments_too(make_run):
    directory = make_run()
    assert collect([directory]).runs[0].directory == directory
    assert collect([directory / "metrics.json"]).runs[0].directory == directory


def test_nothing_to_report_is_wrong_input(make_run, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserInputError, match=r"no metrics.json under .*empty.*: `sw run --out"):
        collect([tmp_path / "empty"])
    with pytest.raises(UserInputError, match="there is no such folder"):
        collect([tmp_path / "absent"])


def test_a_damaged_record_is_left_out_and_named(make_run, tmp_path):
    make_run("r1")
    (make_run("r2") / "metrics.json").write_text("{")
    collection = collect([tmp_path])
    assert [r.label for r in collection.runs] == ["toy r1"]
    assert len(collection.notes) == 1
    assert collection.notes[0].startswith(f"left out: {tmp_path / 'out' / 'garden' / 'toy' / 'r2'}")


def test_a_damaged_record_alone_is_an_error(make_run):
    directory = make_run()
    (directory / "metrics.json").write_text("{")
    with pytest.raises(UserInputError, match="not a result record"):
        collect([directory])


def test_presets_of_a_method_are_told_apart(make_run, tmp_path):
    make_run(out=tmp_path / "a")
    make_run(out=tmp_path / "a" / "more", change=lambda c: c.update(preset="quick"))
    make_run(out=tmp_path / "a", method="other")
    assert [r.label for r in collect([tmp_path / "a"]).runs] == ["other r1", "toy (paper) r1", "toy (quick) r1"]


def test_equal_names_from_two_folders_are_told_apart_by_the_folder(make_run, tmp_path):
    make_run(out=tmp_path / "before")
    make_run(out=tmp_path / "after")
    found = collect([tmp_path / "before", tmp_path / "after"])
    assert [r.label for r in found.runs] == ["toy [after] r1", "toy [before] r1"]
    assert found.notes == []


def test_of_what_stays_equal_the_newest_is_shown_and_told(make_run, tmp_path):
    old = make_run(out=tmp_path / "x")
    make_run(out=tmp_path / "x" / "y", noise=2.0, change=lambda c: c.update(date="2027-01-01T00:00:00+00:00"))
    found = collect([tmp_path / "x"])
    assert [r.facts.date[:4] for r in found.runs] == ["2027"]
    assert found.notes[0].startswith("2 runs of toy r1 on garden have the same name; the newest is shown")
    assert str(old) not in found.notes[0]


def test_protocols_are_not_mixed_silently(make_run, tmp_path):
    make_run()
    make_run("r2", change=lambda c: c["protocol"].update(id="colmap/images/r4/every8/black/pp-center/q8", resolution=4))
    found = collect([tmp_path])
    assert len({r.place for r in found.runs}) == 2
    assert "measured under 2 protocols, which are not comparable" in found.notes[0]


def test_times_of_different_machines_are_told(make_run, tmp_path):
    make_run()
    make_run("r2", change=lambda c: c["environment"].update(threads=1))
    (note,) = collect([tmp_path]).notes
    assert note == (
        "times, FPS and memory come from different machines: cpu, A Processor, 2 threads; cpu, A Processor, 1 thread"
    )


def test_a_copied_directory_says_what_it_said_before(make_run, tmp_path):
    directory = make_run()
    moved = tmp_path / "elsewhere" / "run"
    shutil.copytree(directory, moved)
    shutil.rmtree(directory)
    assert collect([moved]).runs[0].facts.scene == "garden"


def test_numbers_in_names_sort_as_numbers():
    assert sorted(["scan114", "scan24", "Scan9", "scan"], key=natural) == ["scan", "Scan9", "scan24", "scan114"]


def test_a_method_of_different_releases_is_told(make_run, tmp_path):
    make_run("r1")
    make_run("r2", size=2000, change=lambda c: c.update(distribution="sw-toy 0.2"))
    make_run("r1", method="other", change=lambda c: c.update(distribution="sw-other 0.2"))
    assert collect([tmp_path]).notes == ["runs of toy were made by different releases: sw-toy 0.1, sw-toy 0.2"]
