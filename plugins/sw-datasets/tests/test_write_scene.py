"""Scenes written as folders come back through the loaders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sw_datasets.write_scene import quaternion, write_scene

from splatwizard_core.errors import ConfigError, SceneError


def by_name(scene):
    return sorted(scene.train + scene.test, key=lambda view: view.name.split("/")[-1])


def assert_same_views(a, b):
    for x, y in zip(by_name(a), by_name(b), strict=True):
        assert torch.equal(x.pixels, y.pixels)
        torch.testing.assert_close(x.camera.R, y.camera.R, atol=5e-7, rtol=0)  # float32 rotation through 6 figures
        torch.testing.assert_close(x.camera.tau, y.camera.tau, atol=2e-6, rtol=0)
        for field in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(x.camera, field) == pytest.approx(getattr(y.camera, field), rel=1e-12)


@pytest.mark.parametrize("text", [False, True])
def test_a_colmap_folder_comes_back(tiny, tmp_path, load, text):
    write_scene(tiny, tmp_path / "out", text=text)
    assert (tmp_path / "out" / "sparse" / "0" / ("images.txt" if text else "images.bin")).is_file()
    back = load(tmp_path / "out", test_every=4)
    assert_same_views(tiny, back)
    assert [v.name for v in back.test] == [v.name for v in tiny.test]
    assert torch.equal(back.points.xyz, tiny.points.xyz)
    torch.testing.assert_close(back.points.rgb, tiny.points.rgb, atol=0.5 / 255 + 1e-6, rtol=0)
    assert back.extent == pytest.approx(tiny.extent, rel=1e-5)


def test_binary_and_text_give_identical_cameras(tiny, tmp_path, load):
    scenes = []
    for text in (False, True):
        write_scene(tiny, tmp_path / str(text), text=text)
        scenes.append(load(tmp_path / str(text)))
    for a, b in zip(by_name(scenes[0]), by_name(scenes[1]), strict=True):
        assert torch.equal(a.camera.viewmat, b.camera.viewmat)
        assert torch.equal(a.camera.K, b.camera.K)


def test_a_blender_folder_comes_back_with_its_split(tiny, tmp_path, load):
    write_scene(tiny, tmp_path / "out", "blender")
    back = load(tmp_path / "out", init_points=10)
    assert_same_views(tiny, back)
    assert [v.name for v in back.test] == [f"test/{v.name}" for v in tiny.test]


def test_a_blender_folder_cannot_hold_another_lens_per_view(tiny, tmp_path):
    view = replace(tiny.train[0], camera=replace(tiny.train[0].camera, fy=1.0))
    with pytest.raises(SceneError, match="one centred camera"):
        write_scene(replace(tiny, train=[view]), tmp_path / "out", "blender")


def test_a_blender_folder_that_is_not_finished_is_no_scene(tiny, tmp_path):
    def fail():
        raise KeyboardInterrupt

    broken = replace(tiny, test=[*tiny.test[:-1], replace(tiny.test[-1], load=fail)])
    with pytest.raises(KeyboardInterrupt):
        write_scene(broken, tmp_path / "out", "blender")
    assert not list((tmp_path / "out").glob("transforms*"))


def test_a_folder_with_something_in_it_is_left_alone(tiny, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(SceneError, match="not empty"):
        write_scene(tiny, tmp_path)
    with pytest.raises(SceneError, match="not empty"):
        write_scene(tiny, tmp_path / "mine.txt")


def test_an_unknown_format_is_refused(tiny, tmp_path):
    with pytest.raises(ConfigError, match="unknown scene format 'obj': one of colmap, blender"):
        write_scene(tiny, tmp_path / "out", "obj")


def test_a_view_name_may_not_lead_out(tiny, tmp_path):
    with pytest.raises(SceneError, match="leads out"):
        write_scene(replace(tiny, train=[replace(tiny.train[0], name="../x.png")]), tmp_path / "out")


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: sum(x * x for x in q) > 1e-4))
def test_quaternions_agree_with_scipy_up_to_sign(q):
    rotation = Rotation.from_quat(q)
    ours = np.array(quaternion(rotation.as_matrix()))
    x, y, z, w = rotation.as_quat()
    assert abs(abs(ours @ [w, x, y, z]) - 1) < 1e-12
    assert ours[0] >= 0
