"""Pages, tables and plots that `sw run` leaves besides its records."""

import io
import os

import numpy as np
import pytest
import torch
from rich.console import Console
from sw_report import after_run
from sw_report.after_run import plot_above, report_above, report_finished, report_run

from splatwizard_core.errors import SceneError
from splatwizard_core.runs.directory import OWN_FILES
from splatwizard_core.runs.observers import FinishedRun, FinishedRuns
from splatwizard_core.runs.record import read_record
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import Protocol, Scene, View


def scene() -> Scene:
    camera = Camera(48, 32, 40.0, 40.0, 24.0, 16.0, torch.eye(3), torch.zeros(3))
    views = [View(camera, f"v{i}.png", load=lambda: np.zeros((32, 48, 3), np.uint8)) for i in range(5)]
    return Scene("garden", [], views, None, Protocol("colmap"))


def age(path) -> None:
    """Make a file older than what is written now."""
    os.utime(path, (1, 1))


def test_a_run_gets_its_photographs_and_its_page(make_run):
    directory = make_run(keep=("renders", "log"))
    told = []
    assert report_run(directory, scene, told.append) == directory / "report.html"
    assert told == []
    assert sorted(p.name for p in (directory / "truth").iterdir()) == ["v0.png", "v1.png", "v3.png", "v4.png"]
    assert {"truth", "report.html"} <= set(OWN_FILES)  # what --fresh discards


def test_a_page_that_is_newer_than_its_record_stays(make_run):
    directory = make_run()
    age(directory / "metrics.json")
    page = report_run(directory, scene, print)
    before = page.stat().st_mtime_ns

    def never():
        raise AssertionError("the scene is not needed")

    assert report_run(directory, never, print) == page
    assert page.stat().st_mtime_ns == before
    age(page)
    os.utime(directory / "metrics.json")
    report_run(directory, scene, print)
    assert page.stat().st_mtime_ns > 10**9 * 2


def test_the_page_above_holds_all_that_lies_there(make_curve, make_run, tmp_path):
    make_run("r9", size=99_000)  # of an earlier command
    runs = make_curve()
    page = report_above(runs, print)
    assert page == tmp_path / "out" / "garden" / "toy" / "report.html"
    assert "5 runs: 1 method on 1 scene" in page.read_text()
    others = make_curve("other")
    page = report_above([*runs, *others], print)
    assert page == tmp_path / "out" / "garden" / "report.html"
    assert "9 runs: 2 methods on 1 scene" in page.read_text()


def test_a_single_run_has_no_page_above(make_run):
    assert report_above([make_run()], print) is None


def test_a_page_that_cannot_be_made_never_fails_the_run(make_run):
    def gone():
        raise SceneError("the scene went away")

    directory = make_run()
    told = []
    assert report_run(directory, gone, told.append) is None
    (line,) = told
    assert line.startswith(f"warning: {directory / 'report.html'} was not written: the scene went away")
    assert not (directory / "report.html").exists()


def test_the_plot_above_shows_the_runs_of_the_scene_and_is_drawn_again_when_one_is_new(make_curve, make_run, tmp_path):
    runs = make_curve()
    others = make_curve("other", saving=0.5)
    plot = plot_above([*runs, *others], print)
    assert plot == tmp_path / "out" / "garden" / "rd.svg"
    assert ">other<" in plot.read_text()
    for directory in (*runs, *others):
        age(directory / "metrics.json")
    before = plot.stat().st_mtime_ns
    assert plot_above([*runs, *others], print) == plot
    assert plot.stat().st_mtime_ns == before
    third = make_curve("third", saving=0.2)
    plot_above([*runs, *others], print)
    assert ">third<" in plot.read_text()
    assert plot_above(third[:1], print) is None


def test_runs_of_another_protocol_are_not_in_the_plot(make_curve, make_run):
    def half(content):
        content["protocol"] = {**content["protocol"], "id": "colmap/images_2/r-1/every8/black/pp-center/q8"}

    runs = make_curve()
    make_run("r1", method="halved", change=half)
    text = plot_above(runs, print).read_text()
    assert "halved" not in text
    assert "Rate and distortion of toy on garden" in text


def finish(directories, *, json: bool = False):
    """(what `sw run` prints, what it says, the files that it names) for these run directories."""
    out = Console(file=io.StringIO(), width=200, highlight=False, color_system=None)
    console, told, written = None if json else out, [], []
    runs = [FinishedRun(directory, read_record(directory / "metrics.json"), scene) for directory in directories]
    for run in runs:
        report_finished(FinishedRuns([run], False, console, told.append, written))
    report_finished(FinishedRuns(runs, True, console, told.append, written))
    return out.file.getvalue(), told, written


def test_one_run_ends_in_a_table_and_names_its_page(make_run):
    directory = make_run()
    text, told, _ = finish([directory])
    assert text.startswith("garden: 5 test views, protocol colmap/images")
    assert text.splitlines()[-2:] == [f"{directory}/metrics.json", f"{directory}/report.html"]
    assert told == []


def test_several_runs_end_in_one_table_and_name_the_page_above_alone(make_curve, tmp_path):
    text, _, _ = finish(make_curve())
    above = tmp_path / "out" / "garden" / "toy"
    assert text.count("test views") == 1
    assert text.splitlines()[-2:] == [f"{above}/report.html", f"{above}/rd.svg"]
    assert "r1/report.html" not in text
    assert (above / "r1" / "report.html").is_file()


def test_files_of_other_observers_stay_named(make_curve, tmp_path):
    runs = [FinishedRun(d, read_record(d / "metrics.json"), scene) for d in make_curve()]
    theirs = tmp_path / "theirs.csv"
    written = [theirs, runs[0].directory / "report.html"]
    report_finished(FinishedRuns(runs, True, None, print, written))
    assert written[0] == theirs
    assert [path.name for path in written] == ["theirs.csv", "report.html", "rd.svg"]
    assert written[1].parent == runs[0].directory.parent


def test_where_json_is_asked_for_no_table_is_printed(make_run):
    text, told, written = finish([make_run()], json=True)
    assert (text, told) == ("", [])
    assert [path.name for path in written] == ["report.html"]


@pytest.mark.parametrize("error", [SceneError("gone"), KeyError("nobody foresaw this")])
def test_the_table_comes_though_no_page_could_be_made(make_curve, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(after_run, "write_page", fail)
    monkeypatch.setattr(after_run, "rd_svg", fail)
    text, told, written = finish(make_curve())
    assert text.startswith("garden: 5 test views")
    assert written == []
    assert len(told) == 6
    assert all(line.startswith("warning: ") and "\n" not in line for line in told)
