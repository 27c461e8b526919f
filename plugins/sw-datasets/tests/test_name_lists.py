"""Own splits: lists of names, of the user or of the scene, in the protocol id by their hash."""

from __future__ import annotations

import json
import unicodedata

import pytest
from sw_datasets.name_lists import read_lists

from splatwizard_core.errors import SceneError


def names_tested(scene):
    return [view.name for view in scene.test]


@pytest.mark.parametrize(
    "text",
    [
        "003.png\n005.png\n", "\ufeff# held out\r\n003.png\r\n\r\n005.png", "003\n005", '["003.png", "005.png"]',
        '{"test": ["003.png", "005.png"]}', '{"test_filenames": ["images/003.png", "x/005.png"]}',
        '{"train": ["000", "001", "002", "004", "006", "007", "008", "009"], "test": ["003", "005"]}',
    ],
)  # fmt: skip
def test_one_split_has_one_id_however_it_is_written(colmap_folder, load, tmp_path, text):
    file = tmp_path / "held_out.json"
    file.write_text(text, encoding="utf-8")
    scene = load(colmap_folder.write(), split=str(file))
    assert names_tested(scene) == ["003.png", "005.png"]
    assert len(scene.train) == 8
    assert scene.protocol.id == "colmap/images/r-1/names-52adda24746e/black/pp-center/q8"
    assert scene.warnings == ["split by held_out.json: 8 views to train, 2 to test"]


def test_another_split_has_another_id(colmap_folder, load, tmp_path):
    root, ids = colmap_folder.write(), set()
    for names in ("003.png", "004.png", "003.png\n004.png"):
        (tmp_path / "list.txt").write_text(names)
        ids.add(load(root, split=str(tmp_path / "list.txt")).protocol.id)
    assert len(ids) == 3


def test_lists_in_the_scene_are_found_and_can_be_overruled(colmap_folder, load):
    root = colmap_folder.write()
    (root / "test.txt").write_text("002.png\n")
    assert names_tested(load(root)) == ["002.png"]
    assert names_tested(load(root, split="file")) == ["002.png"]
    plain = load(root, split="every8")
    assert names_tested(plain) == ["000.png", "008.png"]
    assert "test.txt of the scene is not used (split = file takes it)" in plain.warnings
    (root / "train.txt").write_text("000.png\n001.png\n")
    scene = load(root)
    assert (len(scene.train), len(scene.test)) == (2, 1)
    assert "7 views are in none of the lists of train.txt and test.txt and are left out" in scene.warnings
    (root / "test.txt").unlink()
    assert len(load(root, split="train.txt").test) == 8  # in the scene's folder; the rest is tested


def test_a_model_folder_may_hold_the_list(colmap_folder, load):
    root = colmap_folder.write()
    (root / "sparse" / "0" / "test.txt").write_text("004.png\n")
    assert names_tested(load(root)) == ["004.png"]


def test_blender_and_transforms_scenes_take_lists_too(tmp_path, load):
    from PIL import Image

    root = tmp_path / "scan"
    (root / "images").mkdir(parents=True)
    frames = []
    for i in range(4):
        Image.new("RGB", (32, 24)).save(root / "images" / f"{i}.png")
        matrix = [[1, 0, 0, i], [0, 1, 0, i * i], [0, 0, 1, 3], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": matrix})
    (root / "list.txt").write_text("2.png\n")
    for name in ("transforms.json", "transforms_train.json"):
        (root / name).write_text(json.dumps({"fl_x": 30, "frames": frames}))
        scene = load(root, split="list.txt")
        assert names_tested(scene) == ["images/2.png"]
        assert "/names-" in scene.protocol.id


def test_unicode_forms_are_one_name(colmap_folder, load, tmp_path):
    colmap_folder.names = ["caf\u00e9.png", "b.png", "c.png"]
    (tmp_path / "list.txt").write_text(unicodedata.normalize("NFD", "caf\u00e9.png"), encoding="utf-8")
    assert names_tested(load(colmap_folder.write(), split=str(tmp_path / "list.txt"))) == ["caf\u00e9.png"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "gives 10 to train and 0 to test"),
        ("nothing.png", "gives 10 to train and 0 to test.*no view is called 'nothing.png'"),
        ('{"train": ["000.png"], "test": ["000.png"]}', "'000.png' is to be trained and tested"),
        ('{"train": [0], "test": [1]}', "'train' must be a list of names"),
        ('{"views": []}', "neither 'train' nor 'test'"),
        ("[" * 100_000, "not readable JSON .its brackets are nested too deeply"),
        ("\n".join(f"{i:03d}.png" for i in range(10)), "gives 0 to train and 10 to test"),
    ],
)
def test_a_list_that_makes_no_split_is_one_clear_line(colmap_folder, load, tmp_path, text, message):
    (tmp_path / "list.txt").write_text(text)
    with pytest.raises(SceneError, match=message) as caught:
        load(colmap_folder.write(), split=str(tmp_path / "list.txt"))
    assert "\n" not in str(caught.value)


def test_names_without_a_view_are_counted_and_names_of_two_views_refused(colmap_folder, load, tmp_path):
    colmap_folder.names = ["a/0.png", "b/0.png", "c.png"]
    root = colmap_folder.write()
    (tmp_path / "list.txt").write_text("c.png\ngone.png\n")
    assert any("1 names in list.txt are of no view" in w for w in load(root, split=str(tmp_path / "list.txt")).warnings)
    (tmp_path / "list.txt").write_text("0.png\n")
    with pytest.raises(SceneError, match=r"'0.png' could be a/0.png or b/0.png"):
        load(root, split=str(tmp_path / "list.txt"))


def test_what_is_no_file_is_an_unknown_rule_and_no_text_is_refused(colmap_folder, load, tmp_path):
    root = colmap_folder.write()
    with pytest.raises(SceneError, match=r"split: held_out\.txt: there is no such file of names"):
        load(root, split="held_out.txt")
    with pytest.raises(SceneError, match=r"split: ~nobody-of-this-name/list.*there is no such file"):
        load(root, split="~nobody-of-this-name/list.txt")
    (tmp_path / "list.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SceneError, match="cannot be read"):
        read_lists(tmp_path / "list.txt")
