"""COLMAP model files: both encodings invert, and damage is an error, never nonsense."""

from __future__ import annotations

import shutil
import struct
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sw_datasets.loaders import colmap_model
from sw_datasets.loaders.colmap_model import (
    MODELS,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    read_model,
    write_model,
)

from splatwizard_core.errors import SceneError

READERS = {
    "cameras": colmap_model.read_cameras,
    "images": colmap_model.read_images,
    "points3D": colmap_model.read_points,
}

reals = st.floats(allow_nan=False, allow_infinity=False, width=64)
words = st.text(st.characters(codec="utf-8", categories=("L", "N", "P")), min_size=1, max_size=8)
names = st.lists(words, min_size=1, max_size=3).map(" ".join)


@st.composite
def cameras(draw, camera_id: int) -> ColmapCamera:
    name, n = MODELS[draw(st.integers(0, 10))]
    sizes = st.integers(1, 1 << 40)
    return ColmapCamera(camera_id, name, draw(sizes), draw(sizes), tuple(draw(st.lists(reals, min_size=n, max_size=n))))


@st.composite
def images(draw, image_id: int, camera_ids: list[int]) -> ColmapImage:
    n = draw(st.integers(0, 4))
    q = tuple(draw(st.lists(reals, min_size=4, max_size=4)))
    t = tuple(draw(st.lists(reals, min_size=3, max_size=3)))
    xys = np.array(draw(st.lists(reals, min_size=2 * n, max_size=2 * n))).reshape(n, 2)
    points = np.array(draw(st.lists(st.integers(-1, 1 << 62), min_size=n, max_size=n)), dtype=np.int64)
    return ColmapImage(image_id, q, t, draw(st.sampled_from(camera_ids)), draw(names), xys, points)


@st.composite
def models(draw) -> ColmapModel:
    camera_ids = draw(st.lists(st.integers(0, 1 << 30), min_size=1, max_size=3, unique=True))
    image_ids = draw(st.lists(st.integers(0, 1 << 30), max_size=3, unique=True))
    n = draw(st.integers(0, 4))
    lengths = draw(st.lists(st.integers(0, 3), min_size=n, max_size=n))
    total = sum(lengths)
    whole = st.integers(0, (1 << 31) - 1)
    points = ColmapPoints(
        ids=np.array(draw(st.lists(st.integers(0, 1 << 62), min_size=n, max_size=n, unique=True)), dtype=np.int64),
        xyz=np.array(draw(st.lists(reals, min_size=3 * n, max_size=3 * n))).reshape(n, 3),
        rgb=np.array(draw(st.lists(st.integers(0, 255), min_size=3 * n, max_size=3 * n)), np.uint8).reshape(n, 3),
        error=np.array(draw(st.lists(reals, min_size=n, max_size=n))),
        track_start=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        track=np.array(draw(st.lists(whole, min_size=2 * total, max_size=2 * total)), np.int32).reshape(total, 2),
    )
    return ColmapModel(
        {i: draw(cameras(i)) for i in camera_ids}, {i: draw(images(i, camera_ids)) for i in image_ids}, points
    )


def assert_equal(a: ColmapModel, b: ColmapModel) -> None:
    assert a.cameras == b.cameras
    assert list(a.images) == list(b.images)
    for x, y in zip(a.images.values(), b.images.values(), strict=True):
        assert (x.id, x.qvec, x.tvec, x.camera_id, x.name) == (y.id, y.qvec, y.tvec, y.camera_id, y.name)
        np.testing.assert_array_equal(x.xys, y.xys)
        np.testing.assert_array_equal(x.point_ids, y.point_ids)
    for field in ("ids", "xyz", "rgb", "error", "track_start", "track"):
        np.testing.assert_array_equal(getattr(a.points, field), getattr(b.points, field), err_msg=field)


@settings(max_examples=60, deadline=None)
@given(models(), st.booleans())
def test_a_model_comes_back_from_either_encoding_bit_for_bit(model, text):
    with tempfile.TemporaryDirectory() as folder:
        write_model(model, Path(folder), text=text)
        assert_equal(read_model(Path(folder)), model)


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_a_binary_file_cut_at_any_byte_names_itself_and_the_offset(colmap_folder, part):
    colmap_folder.names = ["a.png", "bé c.png"]
    colmap_folder.num_points = 2
    colmap_folder.write()
    path = colmap_folder.root / "sparse" / "0" / f"{part}.bin"
    whole = path.read_bytes()
    READERS[part](path)
    for cut in range(len(whole)):
        path.write_bytes(whole[:cut])
        with pytest.raises(SceneError, match=rf"{part}\.bin: truncated.*byte \d+"):
            READERS[part](path)
    path.write_bytes(whole + b"x")
    with pytest.raises(SceneError, match=r"1 bytes too many after the last record"):
        READERS[part](path)


@pytest.mark.parametrize("suffix", ["bin", "txt"])
@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_flipped_bytes_are_read_or_refused_and_never_crash(part, suffix, data):
    with tempfile.TemporaryDirectory() as folder:
        model = data.draw(models())
        write_model(model, Path(folder), text=suffix == "txt")
        path = Path(folder) / f"{part}.{suffix}"
        spoilt = bytearray(path.read_bytes())
        for _ in range(data.draw(st.integers(1, 4))):
            spoilt[data.draw(st.integers(0, len(spoilt) - 1))] ^= data.draw(st.integers(1, 255))
        path.write_bytes(spoilt)
        outcome = ""
        try:
            READERS[part](path)
        except SceneError as error:
            outcome = str(error)
        assert outcome == "" or str(path) in outcome


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("count", [1, 1 << 20, (1 << 64) - 1])
def test_a_claimed_count_is_held_against_the_file_before_anything_is_allocated(tmp_path, part, count):
    path = tmp_path / f"{part}.bin"
    path.write_bytes(struct.pack("<Q", count) + bytes(16))
    with pytest.raises(SceneError, match=rf"truncated: {count} \w+ at byte 0 need at least .* 16 are left"):
        READERS[part](path)


def test_a_claimed_track_length_is_held_against_the_file(tmp_path):
    path = tmp_path / "points3D.bin"
    path.write_bytes(struct.pack("<Q", 1) + bytes(43) + struct.pack("<Q", 1 << 61))
    with pytest.raises(SceneError, match="track elements of point 0 at byte 51"):
        colmap_model.read_points(path)


def test_a_name_that_is_not_utf8_is_refused_with_its_offset(tmp_path):
    path = tmp_path / "images.bin"
    path.write_bytes(struct.pack("<Qi7di", 1, 1, *[0.0] * 7, 1) + b"\xff\0" + struct.pack("<Q", 0))
    with pytest.raises(SceneError, match="name of image 0 at byte 72 is not UTF-8"):
        colmap_model.read_images(path)


def test_an_unknown_camera_model_is_refused(tmp_path):
    path = tmp_path / "cameras.bin"
    path.write_bytes(struct.pack("<QiiQQ", 1, 1, 77, 4, 4) + bytes(96))
    with pytest.raises(SceneError, match="unknown camera model 77 at byte 12"):
        colmap_model.read_cameras(path)


@pytest.mark.parametrize(
    ("part", "text", "message"),
    [
        ("cameras", "1 PINHOLE 32 24 30 30 16", "line 1: .*PINHOLE has 4 parameters, not 3"),
        ("cameras", "# made by hand\n1 NOVEL 32 24 30", "line 2: unknown camera model 'NOVEL'"),
        ("cameras", "1", "line 1: damaged record"),
        ("images", "1 1 0 0 0 0 0 x 1 a.png\n\n", "line 1: damaged record"),
        ("images", "1 1 0 0 0 0 0 0 1\n\n", "line 1: damaged record"),
        ("images", "1 1 0 0 0 0 0 0 1 a.png\n3 4\n", "line 2: .*not triples"),
        ("points3D", "1 0 0 0 256 0 0 0.5", "line 1: .*0..255"),
        ("points3D", "1 0 0 0 1 2 3 0.5 7", "line 1: .*pairs"),
        ("points3D", "99999999999999999999 0 0 0 1 2 3 0.5", "line 1: damaged record"),
    ],
)
def test_a_damaged_text_file_names_the_line(tmp_path, part, text, message):
    path = tmp_path / f"{part}.txt"
    path.write_text(text)
    with pytest.raises(SceneError, match=message):
        READERS[part](path)


def test_text_files_may_have_comments_windows_line_ends_and_no_last_keypoint_line(tmp_path):
    path = tmp_path / "images.txt"
    path.write_bytes(b"# comment\r\n\r\n1 1 0 0 0 0 0 0 7 a b.png\r\n1.5 2.5 -1\r\n2 1 0 0 0 0 0 0 7 c.png")
    images = colmap_model.read_images(path)
    assert [image.name for image in images.values()] == ["a b.png", "c.png"]
    np.testing.assert_array_equal(images[1].xys, [[1.5, 2.5]])
    assert len(images[2].xys) == 0


def test_text_files_may_begin_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_bytes(b"\xef\xbb\xbf1 PINHOLE 4 3 5 5 2 1.5")
    assert colmap_model.read_cameras(path)[1].params == (5, 5, 2, 1.5)


def test_binary_is_preferred_and_a_missing_part_is_named(colmap_folder):
    folder = colmap_folder.write() / "sparse" / "0"
    (folder / "cameras.txt").write_text("nonsense")
    read_model(folder)
    (folder / "points3D.bin").unlink()
    assert len(read_model(folder).points) == 0  # poses alone
    (folder / "images.bin").unlink()
    with pytest.raises(SceneError, match=r"images\.bin \(or \.txt\) is missing"):
        read_model(folder)


@pytest.mark.parametrize("name", ["", "a\0b", " lead.png", "two\nlines.png"])
def test_a_name_that_text_cannot_hold_is_not_written(colmap_folder, name):
    colmap_folder.names = [name]
    with pytest.raises(SceneError, match="cannot be written"):
        write_model(colmap_folder.model(), colmap_folder.root, text=True)


def test_real_models_come_back_from_both_encodings(test_data, tmp_path):
    model = read_model(test_data("mug") / "sparse" / "0")
    for text in (False, True):
        write_model(model, tmp_path / str(text), text=text)
        assert_equal(read_model(tmp_path / str(text)), model)
    original = test_data("mug") / "sparse" / "0" / "images.bin"
    assert (tmp_path / "False" / "images.bin").read_bytes() == original.read_bytes()
    shutil.rmtree(tmp_path / "True")


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("part", ["camera", "image", "point"])
def test_an_id_that_occurs_twice_is_refused(tmp_path, text, part):
    camera = ColmapCamera(4, "PINHOLE", 8, 6, (5.0, 5.0, 4.0, 3.0))
    image = ColmapImage(5, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 4, "a.png", np.empty((0, 2)), np.empty(0, np.int64))
    ids = np.array([6, 6] if part == "point" else [6, 7])
    points = ColmapPoints(
        ids,
        np.zeros((2, 3)),
        np.zeros((2, 3), np.uint8),
        np.zeros(2),
        np.zeros(3, np.int64),
        np.zeros((0, 2), np.int32),
    )
    cameras, images = {4: camera}, {5: image}
    if part == "camera":
        cameras[99] = camera  # the writer writes the record's own id
    if part == "image":
        images[99] = image
    write_model(ColmapModel(cameras, images, points), tmp_path, text=text)
    number = {"camera": 4, "image": 5, "point": 6}[part]
    with pytest.raises(SceneError, match=rf"{part}s?(3D)?\..*{part} id {number} occurs twice; the model is damaged"):
        read_model(tmp_path)


def test_images_of_a_text_model_without_keypoints_are_counted(tmp_path):
    lines = "".join(f"{i} 1 0 0 0 0 0 0 1 {i}.png\n\n" for i in range(3)) + "3 1 0 0 0 0 0 0 1 3.png\n1.5 2.5 -1"
    (tmp_path / "images.txt").write_text(f"# IMAGE_ID ...\n{lines}")
    assert colmap_model.count_images(tmp_path) == len(colmap_model.read_images(tmp_path / "images.txt")) == 4
