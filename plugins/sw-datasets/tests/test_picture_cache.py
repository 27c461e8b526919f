"""Pictures of the demo scene are drawn once on a machine: kept files are checked, bounded, and never needed."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from sw_datasets.demo import picture_cache, synthetic
from sw_datasets.demo.synthetic import DemoSize, make_scene

SIZE = DemoSize(views=2, test_every=2, width=16, height=12, points=50, surface=100, samples=1)
SHAPE = (2, 3, 3)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of kept pictures, not there yet, in a cache of the test's own."""
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / picture_cache.FOLDER


def pixels(value):
    return np.full(SHAPE, value, np.uint8)


def refuse():
    raise AssertionError("drawn again")


def test_a_second_scene_of_the_same_kind_is_not_drawn(folder, monkeypatch):
    drawn = [view.pixels.clone() for view in make_scene(SIZE).train]
    monkeypatch.setattr(synthetic, "draw", lambda *_, **__: refuse())
    views = make_scene(SIZE).train
    assert all((view.pixels == one).all() for view, one in zip(views, drawn, strict=True))
    views[0].pixels[:] = 0  # the array is the view's own
    assert (make_scene(SIZE).train[0].pixels == drawn[0]).all()


@pytest.mark.parametrize(
    ("size", "options"),
    [(replace(SIZE, samples=2), {}), (replace(SIZE, width=8, height=6), {}), (replace(SIZE, views=3), {}),
     (SIZE, {"seed": 1}), (SIZE, {"background": "white"})],
)  # fmt: skip
def test_whatever_changes_the_pixels_has_a_file_of_its_own(folder, size, options):
    for view in make_scene(SIZE).train:
        assert view.pixels.numel()
    before = set(folder.iterdir())
    changed = make_scene(size, **options).train
    from_disk_or_not = [view.pixels for view in changed]
    assert len(set(folder.iterdir()) - before) == len(changed)
    for file in folder.iterdir():
        file.unlink()
    assert all((view.pixels == one).all() for view, one in zip(make_scene(size, **options).train, from_disk_or_not,
                                                               strict=True))  # fmt: skip


def test_other_sources_of_the_generator_have_other_files(folder, monkeypatch):
    view = make_scene(SIZE).train[0]
    assert view.pixels.numel()
    monkeypatch.setattr(picture_cache, "_drawn_by", lambda: b"another version")
    del view.pixels
    assert view.pixels.numel()
    assert len(list(folder.iterdir())) == 2


def flip(file):
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)


def link(file):
    target = file.with_name("elsewhere")
    file.rename(target)
    file.symlink_to(target)


def pipe(file):
    file.unlink()
    os.mkfifo(file)


def folder_there(file):
    file.unlink()
    file.mkdir()


@pytest.mark.parametrize(
    "spoil",
    [flip, link, pipe, folder_there, lambda f: f.write_bytes(f.read_bytes()[:-1]), lambda f: f.write_bytes(b""),
     lambda f: f.write_bytes(f.read_bytes() + b"x"), lambda f: f.chmod(0) or f.write_bytes(b"y" * 50)],
)  # fmt: skip
def test_a_damaged_file_is_drawn_again_and_mended(folder, spoil):
    picture_cache.kept_or_drawn("a", SHAPE, lambda: pixels(1))
    spoil(folder / "a")
    assert (picture_cache.kept_or_drawn("a", SHAPE, lambda: pixels(2)) == 2).all()
    if spoil is not folder_there:  # which is left alone
        assert (picture_cache.kept_or_drawn("a", SHAPE, refuse) == 2).all()


def test_the_oldest_make_room_and_the_size_stays_bounded(folder, monkeypatch):
    one = picture_cache.DIGEST_BYTES + 18
    monkeypatch.setattr(picture_cache, "MAX_BYTES", 3 * one)
    for i, name in enumerate("abcde"):
        picture_cache.kept_or_drawn(name, SHAPE, lambda: pixels(1))
        os.utime(folder / name, (i, i))
    assert {file.name for file in folder.iterdir()} == set("cde")
    assert sum(file.stat().st_size for file in folder.iterdir()) == 3 * one
    monkeypatch.setattr(picture_cache, "MAX_BYTES", one - 1)
    assert (
        picture_cache.kept_or_drawn("f", SHAPE, lambda: pixels(6)) == 6
    ).all()  # too large to keep, and nothing is removed
    assert {file.name for file in folder.iterdir()} == set("cde")


def test_many_at_once_read_whole_pictures_or_draw(folder):
    def ask(i):
        return picture_cache.kept_or_drawn(f"picture {i % 3}", SHAPE, lambda: pixels(i % 3))

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(ask, range(60)))
    assert all((one == i % 3).all() for i, one in enumerate(found))
    assert {file.name for file in folder.iterdir()} == {"picture 0", "picture 1", "picture 2"}


def test_without_a_folder_to_write_to_pictures_are_drawn(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "file" / "cache"))
    for value in (1, 2):
        assert (picture_cache.kept_or_drawn("a", SHAPE, lambda value=value: pixels(value)) == value).all()


def test_a_full_disk_costs_the_kept_file_alone(folder, monkeypatch):
    import errno

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    assert (picture_cache.kept_or_drawn("a", SHAPE, lambda: pixels(1)) == 1).all()
    assert list(folder.iterdir()) == []
