"""The gate: pictures against their cameras in size and turn, alpha and masks used or told."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from sw_datasets.image_checks import same_shape
from sw_datasets.loaders.colmap_model import ColmapCamera

from splatwizard_core.errors import SceneError

QUARTERS = np.zeros((24, 32, 3), np.uint8)
QUARTERS[:12, :16], QUARTERS[:12, 16:], QUARTERS[12:, :16] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
TURNED_BACK = {6: np.rot90(QUARTERS, 1), 8: np.rot90(QUARTERS, -1), 5: QUARTERS.transpose(1, 0, 2)}
"""EXIF orientation -> the stored pixels of QUARTERS."""


def save(path: Path, pixels: np.ndarray, orientation: int = 1) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    # WebP and JPEG are lossy: the quarters survive, their borders do not.
    Image.fromarray(np.ascontiguousarray(pixels)).save(path, exif=exif, quality=100)


def transforms(root: Path, count: int, **header: object) -> Path:
    """The scene of a folder of pictures images/NNN.png as one transforms.json."""
    frames = []
    for i in range(count):
        pose = np.eye(4)
        pose[:3, 3] = (0.1 * i, 0.05 * i * i, 4.0)
        frames.append({"file_path": f"images/{i:03d}.png", "transform_matrix": pose.tolist()})
    (root / "transforms.json").write_text(json.dumps({"fl_x": 30.0, "w": 32, "h": 24, **header, "frames": frames}))
    return root


@pytest.fixture(params=["colmap", "transforms"])
def folder(request, colmap_folder):
    """write() -> a scene of ten pictures images/NNN.png of 32x24, in either layout."""

    def write(**header):
        root = colmap_folder.write()
        if request.param == "transforms":
            (root / "sparse" / "0" / "cameras.bin").unlink()
            transforms(root, 10, **header)
        return root

    return write


def pictures(root):
    return sorted((root / "images").iterdir())


@given(st.integers(40, 5000), st.integers(40, 5000), st.sampled_from([1, 2, 4, 8]))
def test_sizes_rounded_in_either_way_are_of_one_shape_and_cropped_ones_are_not(width, height, factor):
    for up_x in (0, factor - 1):
        for up_y in (0, factor - 1):
            assert same_shape(((width + up_x) // factor, (height + up_y) // factor), (width, height))
    assert not same_shape((width, round(0.8 * height)), (width, height))


@pytest.mark.parametrize("orientation", TURNED_BACK)
@pytest.mark.parametrize("suffix", [".jpg", ".webp", ".tif"])
def test_sideways_pictures_are_turned_by_exif_where_their_cameras_are_upright(folder, load, orientation, suffix):
    root = folder()
    for file in pictures(root):
        save(file.with_suffix(suffix), TURNED_BACK[orientation], orientation)
        file.unlink()
    scene = load(root)
    told = ["10 pictures are turned by their EXIF orientation" in line for line in scene.warnings].count(True)
    assert told == (suffix != ".tif")  # Pillow turns those itself
    view = scene.train[0]
    assert (view.camera.width, view.camera.height, tuple(view.pixels.shape)) == (32, 24, (3, 24, 32))
    middles = view.pixels[:, 6::12, 8::16].permute(1, 2, 0).numpy()
    assert np.abs(middles.astype(int) - QUARTERS[6::12, 8::16]).max() < 12


def test_pictures_that_fit_as_they_are_stored_are_not_turned(folder, load):
    root = folder()
    for file in pictures(root):
        save(file, QUARTERS, 6)
    scene = load(root)
    assert not any("EXIF" in line for line in scene.warnings)
    assert scene.train[0].pixels[:, 2, 2].tolist() == [250, 0, 0]


def test_a_half_turn_that_no_size_can_tell_of_is_not_applied_and_told(folder, load):
    root = folder()
    for file in pictures(root):
        save(file, QUARTERS, 3)
    told = [
        line for line in load(root).warnings if "10 pictures have an EXIF orientation, which is not applied" in line
    ]
    assert "(exif_turn = true turns them, false leaves them)" in told[0]


@pytest.mark.parametrize("orientation", [3, 6])
def test_the_user_decides_about_a_turn_that_no_size_can_tell_of(colmap_folder, load, orientation):
    colmap_folder.picture_size = (32, 32)
    colmap_folder.camera = ColmapCamera(1, "PINHOLE", 32, 32, (30.0, 30.0, 16.0, 16.0))
    root, corners = colmap_folder.write(), np.zeros((32, 32, 3), np.uint8)
    corners[:16, :16] = 250
    for file in pictures(root):
        save(file, corners, orientation)
    kept, turned = load(root, exif_turn=False), load(root, exif_turn=True)
    assert not any("EXIF" in line for line in [*kept.warnings, *turned.warnings])
    y, x = {3: (30, 30), 6: (2, 30)}[orientation]
    assert (kept.train[0].pixels[0, 2, 2], turned.train[0].pixels[0, y, x]) == (250, 250)
    assert (kept.train[0].pixels[0, y, x], turned.train[0].pixels[0, 2, 2]) == (0, 0)
    assert not kept.protocol.turned
    assert turned.protocol.id == f"{kept.protocol.id}/turned"


@pytest.mark.parametrize("content", ["another shape", "no picture"])
def test_a_mask_that_fits_no_picture_refuses_only_a_scene_that_uses_masks(folder, load, content):
    root = folder()
    masks = root / "masks" / ("images" if (root / "transforms.json").exists() else "")
    masks.mkdir(parents=True)
    for file in pictures(root):
        Image.new("L", (32, 24), 255).save(masks / file.name)
    odd = masks / "003.png"
    Image.new("L", (24, 32)).save(odd) if content == "another shape" else odd.write_text("no picture")
    words = {
        "another shape": r"the mask 003\.png is 24x32 px, its image '.*003\.png' 32x24: they differ in aspect",
        "no picture": r"003\.png: not a readable picture",
    }[content]
    (told,) = (line for line in load(root).warnings if "left out" in line)
    assert re.fullmatch(f"1 masks are left out: .*{words}.*", told)
    with pytest.raises(SceneError, match=words):
        load(root, mask_background=True)


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((24, 32), "its sides are swapped"),
        ((32, 20), "cropped or stretched"),
        ((64, 36), "64x36 px, its camera is 32x24"),
    ],
)
def test_a_picture_of_another_shape_than_its_camera_is_refused(folder, load, size, words):
    root = folder()
    Image.new("RGB", size).save(pictures(root)[3])
    with pytest.raises(SceneError, match=f"image '(images/)?003.png' is .*{words}") as caught:
        load(root)
    assert "\n" not in str(caught.value)


def test_a_picture_that_is_a_little_stretched_is_told(colmap_folder, load):
    colmap_folder.camera = ColmapCamera(1, "PINHOLE", 1000, 1000, (900.0, 900.0, 500.0, 500.0))
    colmap_folder.picture_size = (1000, 994)
    assert (
        "10 pictures differ from their cameras in aspect, the most: '000.png' is 1000x994"
        in load(colmap_folder.write()).warnings[-1]
    )


def test_alpha_is_composited_and_told(folder, load):
    root = folder()
    for file in pictures(root):
        Image.new("RGBA", (32, 24), (200, 100, 50, 0)).save(file)
    scene = load(root)
    assert scene.protocol.masked
    assert scene.train[0].image(scene.background).max() == 0
    assert any("10 pictures have alpha: they are composited on black" in line for line in scene.warnings)
    kept = load(root, mask_background=False)
    assert kept.train[0].pixels[:, 0, 0].tolist() == [200, 100, 50]


@pytest.mark.parametrize("place", ["masks/{stem}.png", "mask/{stem}.png", "masks/{stem}.png.png"])
def test_masks_are_told_and_used_on_demand(folder, load, place):
    root = folder()
    below = "images/" if (root / "transforms.json").exists() else ""
    for file in pictures(root):
        mask = root / place.format(stem=f"{below}{file.stem}")
        mask.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (32, 24), 0).save(mask)
        Image.new("RGB", (32, 24), (9, 200, 9)).save(file)
    scene = load(root)
    assert any("the masks of 10 pictures are not used (mask_background = true" in line for line in scene.warnings)
    assert scene.train[0].image().max() > 0.7
    cut = load(root, mask_background=True)
    assert cut.train[0].image().max() == 0
    assert not any("masks" in line for line in cut.warnings)


def test_masks_that_transforms_name_are_found_or_missed(colmap_folder, load):
    root = colmap_folder.write()
    (root / "sparse" / "0" / "cameras.bin").unlink()
    transforms(root, 10)
    data = json.loads((root / "transforms.json").read_text())
    (root / "m").mkdir()
    for i, frame in enumerate(data["frames"]):
        frame["mask_path"] = f"./m/{i}.png"
        if i:
            Image.new("L", (32, 24), 255 * (i % 2)).save(root / "m" / f"{i}.png")
    (root / "transforms.json").write_text(json.dumps(data))
    scene = load(root)
    assert any("1 masks that 'mask_path' names are not there" in line for line in scene.warnings)
    assert any("the masks of 9 pictures are not used" in line for line in scene.warnings)


def test_a_pipe_is_no_picture(folder, load):
    import os

    root = folder()
    pictures(root)[2].unlink()
    os.mkfifo(root / "images" / "002.png")
    with pytest.raises(
        SceneError, match=r"002\.png.*(missing|no file but a folder, a pipe or a device)|images are missing"
    ):
        load(root)
