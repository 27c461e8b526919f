"""One transforms.json: intrinsics in every place, every key used, refused or told, start points, split."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image
from sw_datasets.start_points import points_in_sight, share_in_sight

from splatwizard_core.errors import SceneError
from splatwizard_core.scene.camera import Camera

FX, W, H = 30.0, 32, 24


def pose(i, count):
    a = 2 * math.pi * i / count
    camera = Camera.look_at(
        torch.tensor([3 * math.cos(a), 3 * math.sin(a), 1.0]), torch.zeros(3), torch.tensor([0.0, 0, 1]),
        width=W, height=H, fov_x=1.0,
    )  # fmt: skip
    matrix = np.eye(4)
    matrix[:3, :3] = camera.R.numpy().T * [1, -1, -1]
    matrix[:3, 3] = camera.center.numpy()
    return matrix


@pytest.fixture
def scan(tmp_path):
    """scan(header, frame keys) -> a folder of nine pictures, their poses on a circle."""

    def write(header=None, frame=None, *, name="transforms.json", count=9, size=(W, H)):
        root = tmp_path / "scan"
        (root / "images").mkdir(parents=True, exist_ok=True)
        frames = []
        for i in range(count):
            Image.new("RGB", size, (i, 0, 0)).save(root / "images" / f"{i}.png")
            frames.append(
                {"file_path": f"./images/{i}.png", "transform_matrix": pose(i, count).tolist(), **(frame or {})}
            )
        (root / name).write_text(json.dumps({**(header or {"fl_x": FX}), "frames": frames}))
        return root

    return write


def write_cloud(path, n=7, colours=("red", "green", "blue"), kind="uchar", text=True):
    rows = "".join(f"{i} 0 1" + f" 10 20 {i}" * bool(colours) + "\n" for i in range(n))
    head = "".join(f"property {kind} {c}\n" for c in colours)
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {n}\nproperty double x\nproperty float y\nproperty float z\n"
        f"{head}end_header\n{rows}"
    )


ANGLE_X, ANGLE_Y = 2 * math.atan(W / 2 / FX), 2 * math.atan(H / 2 / 20.0)


@pytest.mark.parametrize("everywhere", [True, False])
@pytest.mark.parametrize(
    ("keys", "focal", "centre"),
    [
        ({"fl_x": FX}, (FX, FX), (16, 12)),
        ({"fl_x": FX, "fl_y": 20.0, "cx": 15.0, "cy": 13.0}, (FX, 20.0), (15, 13)),
        ({"fl_x": 2 * FX, "fl_y": 40.0, "cx": 30.0, "cy": 26.0, "w": 2 * W, "h": 2 * H}, (FX, 20.0), (15, 13)),
        ({"fl_x": 2 * FX, "cx": 30.0, "cy": 26.0, "w": 2 * W}, (FX, FX), (15, 13)),
        ({"fl_x": 2 * FX, "h": 2 * H}, (FX, FX), (16, 12)),
        ({"camera_angle_x": ANGLE_X}, (FX, FX), (16, 12)),
        ({"camera_angle_x": ANGLE_X, "camera_angle_y": ANGLE_Y}, (FX, 20.0), (16, 12)),
        ({"camera_angle_y": ANGLE_Y}, (20.0, 20.0), (16, 12)),
        ({"fl_y": 20.0, "camera_angle_x": ANGLE_X, "w": W, "h": H}, (FX, 20.0), (16, 12)),
        (
            {"fl_x": FX, "camera_model": "OPENCV", "k1": 0.0, "p1": 0, "distortion_params": [0, 0, 0.0]},
            (FX, FX),
            (16, 12),
        ),
    ],
)
def test_intrinsics_stand_for_all_frames_or_for_each(scan, load, keys, focal, centre, everywhere):
    scene = load(scan(keys, None) if everywhere else scan({"x": 0}, keys))
    camera = scene.train[0].camera
    assert (camera.fx, camera.fy) == pytest.approx(focal)
    assert (camera.cx, camera.cy) == pytest.approx(centre)
    assert scene.protocol.id == "transforms/frames/r-1/every8/black/pp-file/q8"
    assert [view.name for view in scene.test] == ["images/0.png", "images/8.png"]


@pytest.mark.parametrize(
    "keys",
    [
        {"distortion_params": [0.1, 0, 0, 0]}, {"k1": 0.01}, {"k4": 1e-4}, {"p2": 0.1}, {"b1": 0.5}, {"s1": 0.1},
        {"distortion_params": 0.2}, {"camera_model": "EQUIRECTANGULAR"}, {"camera_model": "OPENCV_FISHEYE"},
        {"is_fisheye": True}, {"ortho": True},
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json"])
@pytest.mark.parametrize("everywhere", [True, False])
def test_lenses_are_refused_wherever_they_are_told(scan, load, keys, name, everywhere):
    root = scan({"fl_x": FX, **keys}, name=name) if everywhere else scan(None, keys, name=name)
    with pytest.raises(SceneError, match=r"lens distortion|camera of another kind"):
        load(root)


@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json"])
def test_every_key_without_use_is_named_in_one_line(scan, load, name):
    root = scan({"fl_x": FX, "applied_transform": [[1]], "made_by": "x" * 100}, {"depth_file_path": "d.png"}, name=name)
    (line,) = (line for line in load(root, split="every8").warnings if "not used" in line)
    assert line == (
        f"{name}: not used: applied_transform (poses and points stand as they are in the files), depth_file_path "
        "(no depth is trained on), made_by"
    )


def test_a_focal_length_and_an_angle_that_contradict_each_other_are_told(scan, load):
    scene = load(scan({"fl_x": FX, "camera_angle_x": 0.2}))
    assert scene.train[0].camera.fx == FX
    assert any("focal length and angle contradict each other in 9 images" in line for line in scene.warnings)


@pytest.mark.parametrize("colours", [("red", "green", "blue"), ("r", "g", "b"), ()])
@pytest.mark.parametrize(("named", "there"), [("sparse_pc.ply", True), (r"C:\x\sparse_pc.ply", True), (None, True)])
@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json"])
def test_start_points_are_those_named_or_beside(scan, load, named, there, name, colours):
    root = scan({"fl_x": FX, **({"ply_file_path": named} if named else {})}, name=name)
    write_cloud(root / ("sparse_pc.ply" if named else "points3d.ply"), colours=colours)
    scene = load(root, split="every8")
    assert scene.points.xyz[:, 0].tolist() == list(range(7))
    if colours:
        assert scene.points.rgb[3].tolist() == pytest.approx([10 / 255, 20 / 255, 3 / 255])
    assert any("the 7 start points are those of" in line for line in scene.warnings)


def test_a_cloud_that_is_named_and_absent_is_told_and_random_points_are_in_sight(scan, load):
    scene = load(scan({"fl_x": FX, "ply_file_path": "gone.ply"}), init_points=300)
    assert any("ply_file_path 'gone.ply' is not there" in line for line in scene.warnings)
    assert any("300 random ones are laid where the cameras look" in line for line in scene.warnings)
    assert share_in_sight(scene.points.xyz, [view.camera for view in scene.train + scene.test]) == 1.0


def test_what_is_no_cloud_is_one_clear_line(scan, load):
    root = scan()
    (root / "points3d.ply").write_bytes(
        b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n2\n"
    )
    with pytest.raises(SceneError, match=r"points3d\.ply: no cloud of points"):
        load(root)
    (root / "points3d.ply").write_bytes(
        b"ply\nformat ascii 1.0\nelement vertex 99999999\nproperty float x\nend_header\n"
    )
    with pytest.raises(SceneError, match=r"points3d\.ply: .* truncated"):
        load(root)


def test_the_files_own_lists_are_a_split(scan, load):
    names = [f"images/{i}.png" for i in range(9)]
    root = scan({"fl_x": FX, "train_filenames": names[:6], "val_filenames": names[6:], "test_filenames": names[6:8]})
    scene = load(root, split="file")
    assert (len(scene.train), len(scene.test)) == (6, 2)


def test_a_colmap_model_and_blenders_files_go_before(scan, load, colmap_folder):
    root = scan()
    scan(name="transforms_train.json")
    assert load(root, split="every8").protocol.dataset == "blender"
    both = colmap_folder.write()
    (both / "transforms.json").write_text("{}")
    assert load(both).protocol.dataset == "colmap"


def test_parallel_cameras_get_points_too():
    cameras = [
        Camera(W, H, FX, FX, 10.0, 12.0, torch.eye(3, dtype=torch.float64), torch.tensor([-i, 0.0, 0.0]).double())
        for i in (1e6, 1e6 + 1, 1e6 + 2)
    ]
    points = points_in_sight(cameras, 200, 0)
    assert points.xyz.dtype == torch.float64
    assert share_in_sight(points.xyz, cameras) == 1.0
    assert torch.equal(points.xyz, points_in_sight(cameras, 200, 0).xyz)


def test_blender_cameras_that_do_not_see_the_cube_get_points_where_they_look(scan, load):
    root = scan(name="transforms_train.json")
    data = json.loads((root / "transforms_train.json").read_text())
    for frame in data["frames"]:
        frame["transform_matrix"][0][3] += 40.0
        frame["transform_matrix"][2][3] += 40.0
    (root / "transforms_train.json").write_text(json.dumps(data))
    scene = load(root, split="every8", init_points=100)
    assert any("do not look at the cube" in line for line in scene.warnings)
    assert scene.points.xyz[:, 2].min() > 30


def test_intrinsics_of_a_picture_of_another_size_are_told(scan, load):
    about = "more than a quarter of the picture off its centre"
    assert any(about in line for line in load(scan({"fl_x": 2 * FX, "cx": float(W), "cy": float(H)})).warnings)
    sized = load(scan({"fl_x": 2 * FX, "cx": float(W), "cy": float(H), "w": 2 * W, "h": 2 * H}))
    assert not any(about in line for line in sized.warnings)


@pytest.mark.parametrize(
    ("keys", "change", "words"),
    [
        ({"fl_x": 0.0, "w": W, "h": H}, None, "the focal lengths of image 'images/0.png' are 0 and 0 px"),
        (None, lambda m: m.T, "the last row of 'transform_matrix' of image 'images/0.png' is .*: is it transposed"),
        (None, lambda m: m @ np.diag([1, 1, -1, 1]), "is not a rotation and a translation"),
        (None, lambda m: m * [[2.5, 2.5, 2.5, 1]], "is not a rotation and a translation"),
        (None, lambda m: m + 1e30 * np.eye(4, k=3), "the pose of image 'images/0.png' makes no sense"),
    ],
)
def test_cameras_that_make_no_sense_are_one_clear_line(scan, load, keys, change, words):
    root = scan(keys)
    if change is not None:
        data = json.loads((root / "transforms.json").read_text())
        for frame in data["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
        (root / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(SceneError, match=words) as caught:
        load(root)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("change", [lambda m: m @ np.diag([1, -1, -1, 1]), np.linalg.inv], ids=["OpenCV axes", "back"])
def test_cameras_that_see_no_start_point_are_told(scan, load, change):
    root = scan()
    rows = "".join(f"{x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in np.random.default_rng(0).normal(0, 0.2, (200, 3)))
    head = (
        "ply\nformat ascii 1.0\nelement vertex 200\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (root / "points3d.ply").write_text(head + rows)
    assert not any("see none of the start points" in line for line in load(root).warnings)
    data = json.loads((root / "transforms.json").read_text())
    for frame in data["frames"]:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
    (root / "transforms.json").write_text(json.dumps(data))
    assert any("9 of 9 cameras see none of the start points: poses or" in line for line in load(root).warnings)


def test_masks_of_instant_ngp_are_told(scan, load):
    root = scan()
    for i in range(3):
        Image.new("L", (W, H)).save(root / "images" / f"dynamic_mask_{i}.png")
    assert "3 masks dynamic_mask_*.png (instant-ngp) are not used" in load(root).warnings
