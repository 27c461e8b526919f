"""Names of pictures that are not those of the files: Unicode forms, case, Windows and absolute paths."""

from __future__ import annotations

import errno
import json
import os
import unicodedata

import pytest
from PIL import Image
from sw_datasets import picture_names
from sw_datasets.loaders.colmap_model import count_images
from sw_datasets.picture_names import find_pictures, view_name

from splatwizard_core.errors import SceneError


@pytest.fixture
def folder(tmp_path):
    def write(*names):
        for name in names:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_bytes(b"")
        return tmp_path

    return write


def test_a_folder_that_cannot_be_read_is_not_called_empty(folder, monkeypatch):
    def refuse(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(SceneError, match="cannot be read: Permission denied"):
        find_pictures(folder("b.png"), ["a.png"])


@pytest.mark.parametrize("there", ["NFC", "NFD"])
@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_unicode_forms_are_one_name(folder, there, suffix):
    name = "fotos/Caf\u00e9 \u00c5ngstr\u00f6m/\ud55c\uad6d.png"
    path = folder(unicodedata.normalize(there, name).replace("png", suffix))
    for form in ("NFC", "NFD"):
        (found,) = find_pictures(path, [unicodedata.normalize(form, name)])
        assert found.is_file()


@pytest.mark.parametrize(
    "name",
    [
        r"left\001.png", r".\left\001.png", r"C:\Users\me\scan\left\001.png", "D:/scan/left/001.png",
        "/home/me/scan/left/001.png", r"\\server\share\left\001.png", "../scan/left/001.png",
        "../../left/001.jpg",
    ],
)  # fmt: skip
def test_paths_of_other_machines_are_found_by_their_last_parts(folder, name):
    path = folder("left/001.png", "right/001.png", "002.png")
    notes = []
    (found,) = find_pictures(path, [name], notes)
    assert found == path / "left/001.png"
    assert view_name(name, found, path) == "left/001.png"
    assert bool(notes) == (not name.startswith(("left", ".\\left")))


def test_nothing_outside_is_read(folder, tmp_path):
    path = folder("scene/a.png", "secret.png") / "scene"
    for name in ("../secret.png", "../scene/../secret.png"):
        with pytest.raises(SceneError, match="leads out of"):
            find_pictures(path, [name])
    with pytest.raises(SceneError, match="1 of 1 images are missing"):
        find_pictures(path, [str(tmp_path / "secret.png")])
    link = path / "b.png"
    link.symlink_to(path / "a.png")
    assert find_pictures(path, ["b.png"]) == [link]


def test_case_is_told_and_must_be_clear(folder):
    path = folder("IMG_1.JPG", "img_2.png")
    notes = []
    assert find_pictures(path, ["img_1.jpg", "IMG_2.PNG"], notes) == [path / "IMG_1.JPG", path / "img_2.png"]
    assert notes == ["2 picture names differ from those of the files in upper and lower case"]
    folder("Img_1.JPG")
    with pytest.raises(SceneError, match="could both stand for it"):
        find_pictures(path, ["img_1.jpg"])


def test_a_colmap_model_with_absolute_windows_names_is_read(colmap_folder, load):
    root = colmap_folder.write()
    names = [rf"C:\data\garden\images\{name}" for name in colmap_folder.names]
    files = colmap_folder.names
    colmap_folder.names = names
    model = colmap_folder.model()
    from sw_datasets.loaders.colmap_model import write_model

    write_model(model, root / "sparse" / "0")
    scene = load(root)
    assert sorted(view.name for view in scene.train + scene.test) == files
    assert any("10 picture names are paths of another place" in line for line in scene.warnings)


def test_transforms_with_absolute_names_are_read(tmp_path, load):
    root = tmp_path / "scan"
    (root / "images").mkdir(parents=True)
    frames = []
    for i in range(9):
        Image.new("RGB", (32, 24)).save(root / "images" / f"{i}.png")
        matrix = [[1, 0, 0, i / 9], [0, 1, 0, i * i / 99], [0, 0, 1, 3], [0, 0, 0, 1]]
        frames.append({"file_path": f"/home/someone/scan/images/{i}.png", "transform_matrix": matrix})
    (root / "transforms.json").write_text(json.dumps({"fl_x": 30, "frames": frames}))
    scene = load(root)
    assert [view.name for view in scene.test] == ["images/0.png", "images/8.png"]


def test_masks_are_found_in_either_unicode_form(colmap_folder, load):
    colmap_folder.names = [f"caf\u00e9_{i}.png" for i in range(4)]
    root = colmap_folder.write()
    (root / "masks").mkdir()
    for name in colmap_folder.names:
        Image.new("L", (32, 24)).save(root / "masks" / unicodedata.normalize("NFD", name))
    assert load(root, mask_background=True).train[0].image().max() == 0


@pytest.mark.parametrize(
    "place", ["sparse/1", "sparse/12", "colmap/sparse/0", "colmap/sparse", "dense/0/sparse", "dense/sparse"]
)
@pytest.mark.parametrize("text", [True, False])
def test_models_elsewhere_are_read(colmap_folder, load, place, text):
    colmap_folder.sparse, colmap_folder.text = place, text
    if place.startswith("dense/"):
        colmap_folder.pictures = f"{place.removesuffix('/sparse')}/images"
    scene = load(colmap_folder.write())
    assert len(scene.train) + len(scene.test) == 10


def test_of_several_models_the_largest_is_read_unless_one_is_the_first(colmap_folder, load):
    colmap_folder.sparse = "sparse/2"
    root = colmap_folder.write()
    colmap_folder.sparse, colmap_folder.names = "sparse/1", colmap_folder.names[:3]
    colmap_folder.write()
    scene = load(root)
    assert len(scene.train) + len(scene.test) == 10
    assert any(
        "the model in sparse/2 is read (10 images); there is also sparse/1 (3 images)" in w for w in scene.warnings
    )
    colmap_folder.sparse = "sparse/0"
    colmap_folder.write()
    scene = load(root)
    assert len(scene.train) + len(scene.test) == 3
    assert any("there is also sparse/1 (3 images), sparse/2 (10 images)" in w for w in scene.warnings)


def test_points_of_a_ply_serve_where_the_model_has_none(colmap_folder, load):
    colmap_folder.num_points = 0
    root = colmap_folder.write()
    random = load(root, init_points=50)
    assert len(random.points) == 50
    assert any("50 random ones are laid where the cameras look" in line for line in random.warnings)
    (root / "sparse" / "0" / "points3D.bin").unlink()
    assert len(load(root, init_points=50).points) == 50
    (root / "sparse" / "0" / "points3D.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        "1 2 3\n4 5 6\n"
    )
    assert load(root).points.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_many_frames_of_few_pictures_and_endless_names_are_one_short_line(tmp_path, load, monkeypatch):
    """Each name is looked for once, and no picture is opened before all of them are there."""
    looked: list[str] = []
    of = picture_names._Files.of
    monkeypatch.setattr(picture_names._Files, "of", lambda self, name: looked.append(name) or of(self, name))
    monkeypatch.setattr("sw_datasets.image_checks.read_header", None)
    (tmp_path / "images").mkdir()
    Image.new("RGB", (32, 24)).save(tmp_path / "images" / "0.png")
    matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    frames = [{"file_path": "images/0.png", "transform_matrix": matrix}] * 5_000
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30, "frames": frames}))
    with pytest.raises(SceneError, match="occurs more than once"):
        load(tmp_path)
    assert looked == ["images/0.png"]
    frames = [{"file_path": "x" * 60_000, "transform_matrix": matrix}]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30, "frames": frames}))
    with pytest.raises(SceneError) as caught:
        load(tmp_path)
    assert len(str(caught.value)) < 500


def test_of_a_path_of_another_machine_the_last_parts_alone_are_looked_for(tmp_path, monkeypatch):
    looked: list[str] = []
    monkeypatch.setattr(picture_names._Files, "_like", lambda self, name, called: looked.append(name))
    assert picture_names._Files(tmp_path).of("/a" * 30_000) is None
    assert max(looked, key=len) == "/".join(["a"] * picture_names.MOST_PARTS)
    assert len(looked) == picture_names.MOST_PARTS


@pytest.mark.parametrize("name", ["images.txt", "images.bin"])
def test_a_model_whose_images_are_a_pipe_has_none(tmp_path, name):
    os.mkfifo(tmp_path / name)
    assert count_images(tmp_path) == 0


def test_a_folder_is_listed_once_for_all_masks(tmp_path, load, monkeypatch):
    (tmp_path / "images").mkdir()
    frames = []
    for i in range(9):
        Image.new("RGB", (32, 24)).save(tmp_path / "images" / f"{i}.png")
        matrix = [[1, 0, 0, i], [0, 1, 0, i * i], [0, 0, 1, 3], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/{i}.png", "mask_path": f"gone/{i}.png", "transform_matrix": matrix})
    frames[0]["mask_path"] = "./images/0.png"
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30, "frames": frames}))
    listed = []
    walk = picture_names.list_pictures
    monkeypatch.setattr(picture_names, "list_pictures", lambda folder: listed.append(folder) or walk(folder))
    scene = load(tmp_path)
    assert any("8 masks that 'mask_path' names are not there" in line for line in scene.warnings)
    assert listed.count(tmp_path) == 1
