"""Blender scenes: poses, compositing, the split by file, and what is refused."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from splatwizard_core.errors import ConfigError, SceneError

C2W = [[1, 0, 0, 1.0], [0, 0, -1, -4.0], [0, 1, 0, 0.5], [0, 0, 0, 1]]  # at (1, -4, 0.5), looking along +y, z up


@pytest.fixture
def blender_folder(tmp_path):
    """write(train, test, ..) -> folder with transparent pictures; every keyword spoils something."""

    def write(train=3, test=2, *, matrix=None, header=None, frame=None, pictures=True):
        root = tmp_path / "chair"
        for part, count in (("train", train), ("test", test)):
            (root / part).mkdir(parents=True)
            frames = []
            for i in range(count):
                c2w = [list(map(float, row)) for row in C2W]
                c2w[0][3] += i
                frames.append({"file_path": f"./{part}/r_{i}", "transform_matrix": matrix or c2w, **(frame or {})})
                if pictures:
                    Image.new("RGBA", (20, 10), (90, 10, 20, 0)).save(root / part / f"r_{i}.png")
            data = {"camera_angle_x": 0.7, "frames": frames, **(header or {})}
            (root / f"transforms_{part}.json").write_text(json.dumps(data))
        return root

    return write


def test_cameras_look_where_opengl_says(blender_folder, load):
    camera = load(blender_folder()).train[0].camera
    torch.testing.assert_close(camera.center, torch.tensor([1.0, -4.0, 0.5]))
    torch.testing.assert_close(camera.R[2], torch.tensor([0.0, 1.0, 0.0]))  # forward
    torch.testing.assert_close(camera.R[1], torch.tensor([0.0, 0.0, -1.0]))  # down
    assert camera.fov_x == pytest.approx(0.7)
    assert camera.fx == camera.fy


def test_the_split_is_that_of_the_files(blender_folder, load):
    scene = load(blender_folder())
    assert [v.name for v in scene.train] == ["train/r_0.png", "train/r_1.png", "train/r_2.png"]
    assert [v.name for v in scene.test] == ["test/r_0.png", "test/r_1.png"]
    assert scene.protocol.id == "blender/rgba/r-1/file/white/pp-center/q8"


def test_a_principal_point_off_the_middle_is_told(blender_folder, load):
    folder = blender_folder(header={"cx": 7.5, "cy": 5.5})
    scene = load(folder)
    assert (scene.train[0].camera.cx, scene.train[0].camera.cy) == (10, 5)
    assert "the principal point is up to 2.5 px off the image centre" in scene.warnings[0]
    taken = load(folder, principal_point="file")
    assert (taken.train[0].camera.cx, taken.warnings) == (7.5, [])


def test_an_all_transparent_picture_is_all_white_truth(blender_folder, load):
    scene = load(blender_folder())
    assert scene.background.tolist() == [1, 1, 1]
    assert torch.equal(scene.train[0].image(scene.background), torch.ones(3, 10, 20))
    black = load(scene.path, background="black")
    assert torch.equal(black.train[0].image(black.background), torch.zeros(3, 10, 20))
    assert not scene.train[0].mask.any()


def test_legacy_compositing_truncates_to_8_bit_and_is_part_of_the_protocol(blender_folder, load):
    root = blender_folder()
    Image.new("RGBA", (20, 10), (90, 10, 20, 128)).save(root / "train" / "r_0.png")
    exact, legacy = load(root), load(root, legacy_8bit_composite=True)
    expected = [(c * 128 + 255 * 127) / 255 for c in (90, 10, 20)]
    truth = exact.train[0].image(exact.background)[:, 0, 0] * 255
    torch.testing.assert_close(truth, torch.tensor(expected), atol=1e-4, rtol=0)
    assert legacy.train[0].pixels[:, 0, 0].tolist() == [int(c) for c in expected]
    assert legacy.train[1].pixels.unique().tolist() == [255]
    assert legacy.protocol.id.endswith("/composite8")
    assert load(root, legacy_8bit_composite=True, background="black").train[1].pixels.max() == 0


def test_start_points_fill_the_cube_with_near_grey_and_follow_the_seed(blender_folder, load):
    root = blender_folder()
    points = load(root).points
    assert points.xyz.shape == (100_000, 3)
    assert points.xyz.abs().max() <= 1.3
    assert points.xyz.amin() < -1.299
    assert points.rgb.amin() >= 0.5
    assert points.rgb.amax() <= 0.5 + 0.2821 / 255
    again, other = load(root, init_points=7), load(root, init_points=7, seed=1)
    assert len(again.points) == 7
    assert torch.equal(again.points.xyz, load(root, init_points=7).points.xyz)
    assert not torch.equal(again.points.xyz, other.points.xyz)


def test_focal_length_per_frame_goes_before_the_angle(blender_folder, load):
    scene = load(blender_folder(frame={"fl_x": 44.0, "fl_y": 22.0, "w": 40, "h": 20}))
    camera = scene.train[0].camera
    assert (camera.fx, camera.fy) == (22.0, 11.0)  # the file is half as large as w, h


def test_without_test_file_the_training_views_are_split(blender_folder, load):
    root = blender_folder(train=9)
    (root / "transforms_test.json").unlink()
    scene = load(root)
    assert (len(scene.train), len(scene.test), scene.protocol.split) == (7, 2, "every8")
    assert "no transforms_test.json" in scene.warnings[0]


def test_a_camera_model_of_null_is_none(blender_folder, load):
    assert len(load(blender_folder(header={"camera_model": None})).train) == 3


def test_a_suffix_in_the_file_is_that_of_a_picture_which_may_have_been_converted(blender_folder, load):
    root = blender_folder(frame={"file_path": "train/r_1.jpg"}, header={"camera_model": "OPENCV", "k1": 0}, train=1)
    (root / "train" / "r_0.png").rename(root / "train" / "r_1.webp")
    (root / "transforms_test.json").unlink()
    scene = load(root, split="all")
    assert [view.name for view in scene.train] == ["train/r_1.jpg"]
    assert scene.train[0].pixels.shape == (4, 10, 20)


@pytest.mark.parametrize("count", [-1, 10**12])
def test_a_number_of_start_points_that_makes_no_sense_is_refused(blender_folder, load, count):
    with pytest.raises(ConfigError, match=f"init_points is {count}: must be a number of points from 0 to 100,000,000"):
        load(blender_folder(), init_points=count)


def test_a_folder_of_another_kind_that_is_called_a_blender_scene_is_one_clear_line(tmp_path, load):
    with pytest.raises(SceneError, match=r"transforms_train\.json is missing: .* is no Blender scene$"):
        load(f"blender:{tmp_path}")


def test_resolution_rule_applies(blender_folder, load):
    view = load(blender_folder(), resolution=2).train[0]
    assert view.pixels.shape == (4, 5, 10)
    assert view.camera.fov_x == pytest.approx(0.7)


NAN = [[math.nan] * 4] * 4
SKEW = (np.diag([1.0, 2.0, 1.0, 1.0])).tolist()
BROKEN = {
    "NaN pose": ({"matrix": NAN}, r"the pose of image 'train/r_0.png' is not finite"),
    "not a rotation": ({"matrix": SKEW}, r"'train/r_0.png' is not a rotation"),
    "mirrored": ({"matrix": np.diag([-1.0, 1, 1, 1]).tolist()}, r"'train/r_0.png' is not a rotation"),
    "3 numbers": ({"matrix": [1, 2, 3]}, r"'train/r_0.png' is not a 4x4 matrix"),
    "missing images": ({"pictures": False}, r"3 of 3 images are missing: 'train/r_0.png'"),
    "distortion": ({"header": {"k1": 0.1}}, r"'train/r_0.png' has lens distortion.*sw data undistort"),
    "distortion of high order": ({"header": {"k6": 0.1}}, r"'train/r_0.png' has lens distortion"),
    "fisheye": ({"header": {"camera_model": "OPENCV_FISHEYE"}}, r"'train/r_0.png' is of a camera .*'OPENCV_FISHEYE'"),
    "fisheye by flag": ({"frame": {"is_fisheye": True}}, r"'train/r_0.png' is of a camera of another kind .is_fisheye"),
    "model of no name": ({"frame": {"camera_model": [1]}}, r"'train/r_0.png' is of a camera of another kind"),
    "text as number": ({"frame": {"fl_x": "long"}}, r"'fl_x' of image 'train/r_0.png' is 'long', not a number"),
    "angle": ({"header": {"camera_angle_x": 4.0}}, r"camera_angle_x is 4.0, must lie between 0 and pi"),
    "frames": ({"header": {"frames": 3}}, r"'frames' must be a list"),
    "no file name": ({"frame": {"file_path": 3}}, r"frame 0 has no 'file_path'"),
    "leads out": ({"frame": {"file_path": "../x"}}, r"leads out of"),
    "endless name": ({"frame": {"file_path": "x" * 400}}, r"3 of 3 images are missing"),
    "no view": ({"train": 0}, r"has 0 views to train and 2 to test"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_scene_is_one_clear_line(blender_folder, load, case):
    spoilt, message = BROKEN[case]
    root = blender_folder(**spoilt)
    with pytest.raises(SceneError, match=message) as caught:
        load(root)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[1]", "[" * 100_000, '{"frames": [1e999]}'])
def test_a_file_that_is_no_such_json_is_one_clear_line(blender_folder, load, text):
    root = blender_folder()
    (root / "transforms_train.json").write_text(text)
    with pytest.raises(SceneError, match=r"transforms_train\.json") as caught:
        load(root)
    assert "\n" not in str(caught.value)
