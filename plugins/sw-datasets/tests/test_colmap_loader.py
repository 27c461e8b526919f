"""COLMAP scenes: what is read, what is refused and in which words."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from sw_datasets.loaders.colmap import pinhole, pose
from sw_datasets.loaders.colmap_model import MODELS, ColmapCamera, ColmapImage

from splatwizard_core.errors import SceneError


@pytest.mark.parametrize("sparse", ["sparse/0", "sparse"])
@pytest.mark.parametrize("text", [False, True])
def test_views_points_and_protocol_are_read(colmap_folder, load, text, sparse):
    colmap_folder.text, colmap_folder.sparse = text, sparse
    scene = load(colmap_folder.write())
    assert [view.name for view in scene.test] == ["000.png", "008.png"]
    assert [view.name for view in scene.train][:3] == ["001.png", "002.png", "003.png"]
    assert scene.name == "garden"
    assert scene.protocol.id == "colmap/images/r-1/every8/black/pp-center/q8"
    assert scene.points.xyz.shape == (5, 3)
    assert scene.points.rgb.dtype == torch.float32
    torch.testing.assert_close(scene.points.rgb, torch.full((5, 3), 0.2))
    assert scene.warnings == []


def test_extent_is_measured_over_the_training_cameras_alone(colmap_folder, load):
    scene = load(colmap_folder.write())
    centres = np.array([i for i in range(1, 11) if i not in (1, 9)], dtype=float)  # files 000 and 008 are tested
    assert scene.extent == pytest.approx(1.1 * np.abs(centres - centres.mean()).max())


def test_pose_is_world_to_camera(colmap_folder, load):
    camera = load(colmap_folder.write()).train[0].camera
    torch.testing.assert_close(camera.center, torch.tensor([2.0, 0.0, 0.0]))


def test_pictures_are_decoded_only_when_asked_for(colmap_folder, load):
    root = colmap_folder.write()
    header = (root / "images" / "001.png").read_bytes()[:60]
    (root / "images" / "001.png").write_bytes(header)  # size can be read, pixels cannot
    scene = load(root)
    assert scene.train[0].camera.width == 32
    with pytest.raises(SceneError, match=r"001\.png: the picture cannot be decoded"):
        _ = scene.train[0].pixels
    assert scene.train[1].pixels.shape == (3, 24, 32)
    assert scene.train[1].pixels[:, 0, 0].tolist() == [2, 4, 6]


def test_field_of_view_is_that_of_colmaps_size_whatever_the_size_of_the_file(colmap_folder, load):
    colmap_folder.picture_size = (17, 12)
    camera = load(colmap_folder.write()).train[0].camera
    assert (camera.width, camera.height) == (17, 12)
    assert camera.fov_x == pytest.approx(2 * math.atan(32 / (2 * 30.0)))
    assert camera.fov_y == pytest.approx(2 * math.atan(24 / (2 * 30.0)))
    assert (camera.cx, camera.cy) == (8.5, 6.0)


def test_resolution_rule_resizes_pictures_and_cameras_together(colmap_folder, load):
    view = load(colmap_folder.write(), resolution=2).train[0]
    assert (view.camera.width, view.camera.height) == (16, 12)
    assert view.pixels.shape == (3, 12, 16)
    assert view.camera.fx == 15.0


def test_an_off_centre_principal_point_is_centred_with_a_warning_or_used(colmap_folder, load):
    colmap_folder.camera = ColmapCamera(1, "PINHOLE", 32, 24, (30.0, 31.0, 19.5, 12.0))
    root = colmap_folder.write()
    centred = load(root)
    assert (centred.train[0].camera.cx, centred.train[0].camera.cy) == (16, 12)
    assert "principal point is up to 3.5 px off" in centred.warnings[0]
    used = load(root, principal_point="file", resolution=2)
    assert (used.train[0].camera.cx, used.train[0].camera.cy) == (9.75, 6)
    assert used.warnings == []
    assert "pp-file" in used.protocol.id


def test_less_than_a_pixel_off_centre_is_not_worth_a_warning(colmap_folder, load):
    colmap_folder.camera = ColmapCamera(1, "PINHOLE", 32, 24, (30.0, 31.0, 16.9, 12.0))
    assert load(colmap_folder.write()).warnings == []


def test_names_with_spaces_folders_dots_and_accents_are_kept_whole(colmap_folder, load):
    colmap_folder.names = ["a b.png", "left/001.png", "right/001.png", "a.b.png", "ünï/ço dé.png"]
    scene = load(colmap_folder.write(), test_every=2)
    views = sorted(scene.train + scene.test, key=lambda v: v.name)
    assert [v.name for v in views] == sorted(colmap_folder.names)
    colours = {name: [i, 2 * i, 3 * i] for i, name in enumerate(colmap_folder.names)}
    assert {v.name: v.pixels[:, 0, 0].tolist() for v in views} == colours


def test_another_suffix_serves_where_the_named_file_is_missing(colmap_folder, load):
    root = colmap_folder.write()
    (root / "images").rename(root / "images_2")
    for file in (root / "images_2").iterdir():
        Image.open(file).save(file.with_suffix(".JPG"), format="JPEG")
        file.unlink()
    scene = load(root, images="images_2")
    assert scene.train[0].name == "001.png"
    assert scene.train[0].pixels.shape == (3, 24, 32)
    assert "/images_2/" in scene.protocol.id


def test_pictures_without_a_pose_are_counted(colmap_folder, load):
    root = colmap_folder.write()
    Image.new("RGB", (8, 8)).save(root / "images" / "extra.png")
    assert load(root).warnings == ["1 of 11 pictures in images have no pose and are not used"]


def test_points_that_are_not_finite_are_dropped_and_counted(colmap_folder, load, monkeypatch):
    model = colmap_folder.model()
    model.points.xyz[1, 0] = np.nan
    model.points.xyz[3, 2] = 1e300  # beyond float32
    monkeypatch.setattr(colmap_folder, "model", lambda: model)
    scene = load(colmap_folder.write())
    assert len(scene.points) == 3
    assert scene.warnings == ["dropped 2 of 5 points that are not finite"]


def test_alpha_is_composited_unless_it_is_to_be_a_mask_only(colmap_folder, load):
    root = colmap_folder.write()
    rgba = np.zeros((24, 32, 4), np.uint8)
    rgba[..., :3], rgba[:, :16, 3] = 200, 255
    for name in colmap_folder.names:
        Image.fromarray(rgba).save(root / "images" / name)
    scene = load(root, mask_background=False)
    kept = scene.train[0]
    assert (scene.protocol.masked, scene.warnings) == (False, [])
    assert kept.pixels.shape == (3, 24, 32)
    assert kept.mask.sum() == 24 * 16
    assert kept.image()[0, 0, 31] == pytest.approx(200 / 255)
    assert load(root, mask_background=True).warnings == []
    cut = load(root)
    assert "10 pictures have alpha: they are composited on black" in cut.warnings[0]
    assert cut.train[0].pixels.shape == (4, 24, 32)
    assert cut.train[0].image()[0, 0, 31] == 0
    assert cut.protocol.id.endswith("/masked")


@pytest.mark.parametrize("pattern", ["masks/{}.png", "mask/{}"])
def test_mask_pictures_are_found(colmap_folder, load, pattern):
    root = colmap_folder.write()
    file = root / pattern.format("001.png")
    file.parent.mkdir()
    mask = Image.new("L", (32, 24))
    mask.paste(255, (0, 0, 32, 6))
    mask.save(file)
    scene = load(root, resolution=2)
    assert scene.train[0].mask.shape == (12, 16)
    assert scene.train[0].mask[:3].all()
    assert not scene.train[0].mask[3:].any()
    assert scene.train[1].mask is None


@pytest.mark.parametrize("pattern", ["{}.jpg", "{}_mask.png", "mask_{}.png", "{}.mask.png", "{}.png"])
@pytest.mark.parametrize("folders", [True, False])
def test_masks_are_found_by_other_names_and_those_of_no_image_told(colmap_folder, load, pattern, folders):
    if folders:
        colmap_folder.names = [f"left/{name}" for name in colmap_folder.names]
    root = colmap_folder.write()
    (root / "masks").mkdir()
    for name in ("000", "001", "another"):
        Image.new("L", (32, 24), 255).save(root / "masks" / pattern.format(name))
    told = load(root).warnings
    found = pattern != "{}.mask.png"
    assert any("the masks of 2 pictures are not used" in line for line in told) == found
    assert any(f"{1 if found else 3} of 3 pictures in masks are the mask of no image" in line for line in told)


@pytest.mark.parametrize("sparse", ["colmap_text", "."])
def test_a_model_is_found_beside_the_pictures(colmap_folder, load, sparse):
    colmap_folder.sparse = sparse
    scene = load(colmap_folder.write())
    assert (len(scene.train), len(scene.test)) == (8, 2)
    assert scene.protocol.id.startswith("colmap/images/")


def test_files_that_macos_writes_beside_pictures_are_none(colmap_folder, load):
    root = colmap_folder.write()
    (root / "images" / "._000.png").write_bytes(b"\0\5\x16\7")
    assert not any("have no pose" in line for line in load(root).warnings)


def test_a_picture_folder_of_another_name_is_named(colmap_folder, load):
    colmap_folder.pictures = "input"
    with pytest.raises(SceneError, match=r"picture folder 'images' is missing; there is input \(--images input\)"):
        load(colmap_folder.write())
    assert load(colmap_folder.root, images="input").protocol.id.startswith("colmap/input/")


DISTORTED = [name for name, _ in MODELS.values() if name not in ("SIMPLE_PINHOLE", "PINHOLE", "EQUIRECTANGULAR")]


@pytest.mark.parametrize("model", DISTORTED)
def test_a_distorted_camera_model_is_named_with_the_way_out(colmap_folder, load, model):
    n = dict(MODELS.values())[model]
    colmap_folder.camera = ColmapCamera(1, model, 32, 24, (30.0,) * (n - 1) + (1e-3,))
    with pytest.raises(SceneError, match=f"lens model {model};.*sw data undistort .*garden OUT") as caught:
        load(colmap_folder.write())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "FOV", "SIMPLE_DIVISION", "DIVISION"]
)
def test_a_distorted_model_whose_coefficients_are_zero_is_a_pinhole(tmp_path, model):
    n = dict(MODELS.values())[model]
    two = model in ("OPENCV", "FULL_OPENCV", "FOV", "DIVISION")
    given = (30.0, 31.0, 16.0, 12.0) if two else (30.0, 16.0, 12.0)
    camera = ColmapCamera(1, model, 32, 24, given + (0.0,) * (n - len(given)))
    assert pinhole(camera, tmp_path) == ((30.0, 31.0, 16.0, 12.0) if two else (30.0, 30.0, 16.0, 12.0))


def test_a_fisheye_with_zero_coefficients_is_still_no_pinhole(tmp_path):
    camera = ColmapCamera(1, "OPENCV_FISHEYE", 32, 24, (30.0, 30.0, 16.0, 12.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(SceneError, match="OPENCV_FISHEYE"):
        pinhole(camera, tmp_path)


def truncate(folder):
    root = folder.write()
    file = root / "sparse" / "0" / "images.bin"
    file.write_bytes(file.read_bytes()[:100])
    return root


def remove_pictures(folder):
    root = folder.write()
    for name in folder.names[1:8]:
        (root / "images" / name).unlink()
    return root


def adjusted(**changes):
    def spoil(folder):
        for key, value in changes.items():
            setattr(folder, key, value)
        return folder.write()

    return spoil


def other_camera(folder):
    model = folder.model()
    image = model.images[3]
    model.images[3] = replace(image, camera_id=9)
    folder.model = lambda: model
    return folder.write()


def no_picture_inside(folder):
    root = folder.write()
    (root / "images" / "004.png").write_bytes(b"not a picture")
    return root


def rename_pictures(folder):
    root = folder.write()
    (root / "images").rename(root / "images_4")
    return root


BROKEN = {
    "missing images": (remove_pictures, r"7 of 10 images are missing: '001\.png', .* '005\.png', \.\.\.$"),
    "missing picture folder": (rename_pictures, r"folder 'images' is missing; there is images_4 \(--images images_4\)"),
    "truncated .bin": (truncate, r"images\.bin: truncated: 10 images"),
    "zero images": (adjusted(names=[]), r"no registered image; a scene needs at least 2"),
    "one camera": (adjusted(names=["a.png"]), r"of 1 view gives 0 to train and 1 to test: .*at least 2 views"),
    "NaN pose": (adjusted(nan_pose_of="005.png"), r"the pose of image '005\.png' is not finite"),
    "focal length 0": (
        adjusted(camera=ColmapCamera(1, "SIMPLE_PINHOLE", 32, 24, (0.0, 16.0, 12.0))),
        r"intrinsics of image '000\.png' make no sense",
    ),
    "size 0": (adjusted(camera=ColmapCamera(1, "PINHOLE", 0, 24, (1.0, 1.0, 0.0, 12.0))), r"camera 1 is 0x24 px"),
    "size beyond any float": (
        adjusted(text=True, camera=ColmapCamera(1, "PINHOLE", 10**400, 24, (1.0, 1.0, 0.0, 12.0))),
        r"camera 1 is 10+x24 px",
    ),
    "unknown camera": (other_camera, r"image '002\.png' refers to camera 9, which is not in cameras"),
    "no picture": (no_picture_inside, r"004\.png: not a readable picture"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_scene_is_one_clear_line(colmap_folder, load, case):
    spoil, message = BROKEN[case]
    with pytest.raises(SceneError) as caught:
        load(spoil(colmap_folder))
    text = str(caught.value)
    assert re.search(message, text)
    assert "\n" not in text
    assert str(colmap_folder.root) in text
    assert caught.value.exit_status == 2


def test_a_name_that_leads_out_of_the_folder_is_refused(colmap_folder, load):
    colmap_folder.names = ["a.png", "../../secret.png"]
    with pytest.raises(SceneError, match="leads out of"):
        load(colmap_folder.write())


def test_a_quaternion_of_any_length_is_its_direction():
    for length in (1e-200, 1.0, 1e200):
        image = ColmapImage(1, (length, length, 0.0, 0.0), (0.0, 0.0, 0.0), 1, "a", np.empty((0, 2)), np.empty(0))
        R, _ = pose(image)
        torch.testing.assert_close(R, torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double())


def test_one_camera_can_be_fitted_with_split_all(colmap_folder, load):
    colmap_folder.names = ["a.png"]
    scene = load(colmap_folder.write(), split="all")
    assert (len(scene.train), len(scene.test), scene.extent) == (1, 1, 1.0)
    assert "one training camera: the scene extent is set to 1.0" in scene.warnings[0]
