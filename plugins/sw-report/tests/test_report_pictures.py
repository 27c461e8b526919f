"""Pictures of the page: where they come from, that they are the right ones, and how many."""

import base64
import io
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from sw_report import pictures
from sw_report.pictures import (
    GAIN,
    Picture,
    PictureBudget,
    encode,
    pick_evenly,
    scene_gallery,
    single_gallery,
    views_per_scene,
)
from sw_report.runs import collect
from sw_report.training_log import read_training
from sw_report.truth import Truth, even_views, keep_truth, shown_views

from splatwizard_core.errors import SceneError, UserInputError
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import Protocol, Scene, View

HEIGHT, WIDTH = 32, 48


def photograph(view: int) -> np.ndarray:
    """What the run directories of these tests were made with."""
    x, y = np.meshgrid(np.linspace(0, 1, WIDTH), np.linspace(0, 1, HEIGHT))
    return np.stack([200 * x, 200 * y, 40 + 20.0 * view + 0 * x], axis=2).astype(np.uint8)


def scene_of(make=photograph, views: int = 5) -> Scene:
    """A scene with the photographs as test views."""
    camera = Camera(WIDTH, HEIGHT, 40.0, 40.0, 24.0, 16.0, torch.eye(3), torch.zeros(3))
    found = [View(camera, f"v{i}.png", load=lambda i=i: make(i)) for i in range(views)]
    return Scene("garden", [], found, None, Protocol("colmap"))


def decoded(picture: Picture) -> np.ndarray:
    head, _, data = picture.uri.partition(",")
    assert head == "data:image/jpeg;base64"
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))).astype(int)


def single(directory: Path, opener=None):
    run = collect([directory]).runs[0]
    return single_gallery(run, Truth([run], opener), PictureBudget())


@pytest.mark.parametrize(
    ("views", "wanted", "expected"),
    [(0, 4, []), (1, 4, [0]), (3, 4, [0, 1, 2]), (7, 4, [0, 2, 4, 6]), (200, 4, [25, 75, 125, 175]), (5, 1, [2])],
)
def test_views_are_spread_evenly(views, wanted, expected):
    assert even_views(views, wanted) == expected


def test_the_page_shows_even_views_the_worst_and_the_best(make_run):
    directory = make_run(
        views=9, change=lambda c: c["metrics"]["psnr"].update(per_view=[30, 31, 9, 30, 30, 50, *[30] * 3])
    )
    assert shown_views(collect([directory]).runs[0].facts) == [1, 2, 3, 5, 7]


def test_differences_are_those_of_the_originals_times_the_gain(make_run):
    directory = make_run(noise=10.0)
    gallery = single(directory)
    assert gallery.notes == []
    row = next(r for r in gallery.rows if r.name == "v0.png")
    render = np.asarray(Image.open(directory / "renders" / "v0.png")).astype(int)
    expected = np.minimum(GAIN * np.abs(render - photograph(0)), 255)
    assert np.abs(decoded(row.shown[0].difference) - expected).mean() < 8  # JPEG of noise
    assert np.abs(decoded(row.truth) - photograph(0)).mean() < 2
    assert {r.remark for r in gallery.rows} == {"", "lowest PSNR of all views", "highest PSNR of all views"}


def test_truth_that_was_not_kept_is_read_from_the_scene(make_run):
    directory = make_run(keep=("renders",))
    gallery = single(directory, lambda run: scene_of())
    assert all(row.truth is not None and row.shown[0].difference is not None for row in gallery.rows)


def test_a_moved_run_says_that_its_scene_is_not_here(make_run):
    def gone(run):
        raise SceneError("/far/away: there is no such folder")

    gallery = single(make_run(keep=("renders",)), gone)
    assert all(row.truth is None and row.shown[0].render is not None for row in gallery.rows)
    assert gallery.notes == [
        "no ground truth: the run kept none, and its scene is not here (/far/away: there is no such folder)"
    ]


def test_another_picture_than_the_scored_one_is_not_shown(make_run):
    """The scene at that path may have changed, or be read by other rules now."""
    directory = make_run(keep=("renders",))
    gallery = single(directory, lambda run: scene_of(lambda i: photograph(i)[::-1].copy()))
    assert all(row.truth is None and row.shown[0].difference is None for row in gallery.rows)
    assert gallery.notes == ["no ground truth: the picture found is not the one that was scored"]


def test_missing_and_damaged_renders_are_said(make_run):
    gallery = single(make_run(keep=("truth",)))
    assert gallery.notes == ["toy r1: its renders are not in its folder"]
    assert all(row.truth is not None for row in gallery.rows)
    directory = make_run("r2")
    for path in (directory / "renders").iterdir():
        path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    assert "a render cannot be read" in single(directory).notes[0]


def test_a_picture_of_absurd_size_is_not_decoded(make_run):
    directory = make_run()
    Image.new("1", (20_000, 4000)).save(absurd := directory / "absurd.png")
    for path in (directory / "renders").iterdir():
        path.write_bytes(absurd.read_bytes())
    assert "is 20000 x 4000 px" in single(directory).notes[0]


def test_a_pipe_in_place_of_a_file_is_not_waited_for(make_run):
    directory = make_run()
    for name in ("renders/v0.png", "truth/v1.png", "log.jsonl"):
        (directory / name).unlink()
        os.mkfifo(directory / name)
    assert "toy r1: its renders are not in its folder" in single(directory).notes
    assert read_training(directory / "log.jsonl").missing == "no log.jsonl"
    (directory / "metrics.json").unlink()
    os.mkfifo(directory / "metrics.json")
    with pytest.raises(UserInputError, match=r"no metrics\.json"):
        collect([directory])


def test_a_run_that_was_scored_against_another_photograph_gets_no_difference(make_run):
    right = make_run("r1")
    wrong = make_run("r2", size=5000, change=lambda c: c["metrics"]["psnr"].update(per_view=[60.0] * 5))
    runs = collect([right, wrong]).runs
    gallery = scene_gallery(runs, 1, Truth(runs, None), PictureBudget())
    assert [s.difference is not None for s in gallery.rows[0].shown] == [True, False]
    assert gallery.notes == ["toy r2: no difference, the photograph is not the one that its record was scored against"]


def test_kept_photographs_are_those_of_the_page_and_exact(make_run):
    directory = make_run(views=9, keep=("renders",))
    facts = collect([directory]).runs[0].facts
    keep_truth(directory, facts, scene_of(views=9))
    kept = sorted(p.name for p in (directory / "truth").iterdir())
    assert kept == [f"v{i}.png" for i in shown_views(facts)]
    assert np.array_equal(np.asarray(Image.open(directory / "truth" / kept[0])), photograph(shown_views(facts)[0]))
    gallery = single(directory, None)
    assert all(row.truth is not None and row.shown[0].difference is not None for row in gallery.rows)


def test_several_runs_show_the_same_views(make_curve, tmp_path):
    make_curve("a")
    make_curve("b")
    runs = collect([tmp_path]).runs
    gallery = scene_gallery(runs, 2, Truth(runs, None), PictureBudget())
    assert [len(row.shown) for row in gallery.rows] == [8, 8]
    assert all(s.render is not None and s.difference is not None for row in gallery.rows for s in row.shown)


def test_more_runs_than_fit_are_picked_evenly_and_it_is_said(make_run, tmp_path):
    for i in range(12):
        make_run(f"r{i}", views=2, size=1000 + i)
    runs = collect([tmp_path]).runs
    assert [r.facts.rate for r in pick_evenly(runs, 4)] == ["r0", "r4", "r7", "r11"]
    gallery = scene_gallery(runs, 1, Truth(runs, None), PictureBudget())
    assert len(gallery.rows[0].shown) == 8
    assert gallery.notes == ["pictures of 8 of 12 runs, spread evenly over the table"]


def test_pictures_are_scaled_to_the_longest_side():
    picture = encode(np.zeros((300, 2000, 3), np.uint8), 640)
    assert (picture.width, picture.height) == (640, 96)
    assert encode(np.zeros((30, 20, 3), np.uint8), 640).width == 20


def test_the_budget_holds_and_what_it_drops_is_said(make_run, monkeypatch):
    directory = make_run(views=9)
    run = collect([directory]).runs[0]
    budget = PictureBudget(pictures=4)
    gallery = single_gallery(run, Truth([run], None), budget)
    shown = [p for r in gallery.rows for p in (r.truth, *(x for s in r.shown for x in (s.render, s.difference))) if p]
    assert len(shown) == 4
    assert gallery.notes == [
        "some pictures are left out: the page holds as many as it may",
        "some views are left out: the page holds as many pictures as it may",
    ]
    small = PictureBudget(size=3000)
    gallery = single_gallery(run, Truth([run], None), small)
    assert small.used <= 3000
    assert gallery.notes


def test_a_page_never_plans_more_pictures_than_it_may_hold():
    assert views_per_scene([1], 4) == 4
    assert views_per_scene([5] * 10, 4) == 1
    assert views_per_scene([8] * 100, 4) == 1
    for scenes in ([3, 3], [8], [1] * 20):
        pictures_each = sum(1 + 2 * n for n in scenes)
        assert views_per_scene(scenes, 4) * pictures_each <= pictures.MOST_PICTURES
