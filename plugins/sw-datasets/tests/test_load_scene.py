"""From what the user typed to the family that reads it."""

from __future__ import annotations

import sys
import types

import pytest
from PIL import Image

from splatwizard_core.errors import SceneError
from splatwizard_core.plugins.registry import Registry
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene


class Plugins:
    """Just a dataset registry with families that score what they are told."""

    def __init__(self, monkeypatch, **scores):
        self.datasets = Registry("dataset")
        module = types.ModuleType("made_up_families")
        monkeypatch.setitem(sys.modules, "made_up_families", module)
        for name, score in scores.items():
            family = types.SimpleNamespace(detect=lambda path, s=score: s, load=lambda path, options, n=name: (n, path))
            setattr(module, name, family)
            self.datasets.add(name, f"made_up_families:{name}", summary="")


def test_the_surest_family_reads_the_scene(monkeypatch, tmp_path):
    plugins = Plugins(monkeypatch, low=0.4, high=0.6, none=0.0)
    assert load_scene(str(tmp_path), SceneOptions(), plugins)[0] == "high"


def test_two_equally_sure_families_are_an_error_that_offers_a_way_out(monkeypatch, tmp_path):
    plugins = Plugins(monkeypatch, one=0.6, two=0.6, three=0.5)
    with pytest.raises(SceneError, match=f"could be any of: one, two; say which with --scene one:{tmp_path}"):
        load_scene(str(tmp_path), SceneOptions(), plugins)
    assert load_scene(f"two:{tmp_path}", SceneOptions(), plugins) == ("two", tmp_path)


def test_a_family_that_cannot_be_imported_harms_nothing_else(monkeypatch, tmp_path, caplog):
    plugins = Plugins(monkeypatch, good=0.5)
    plugins.datasets.add("broken", "no_such_module_anywhere:Family", summary="")
    assert load_scene(str(tmp_path), SceneOptions(), plugins)[0] == "good"
    assert "no_such_module_anywhere" in caplog.text


def test_nothing_recognised_says_what_was_looked_for(tmp_path, load):
    with pytest.raises(SceneError, match=r"not a scene of a known family. Looked for .*sparse/0/cameras\.bin"):
        load(tmp_path)


@pytest.mark.parametrize("folder", ["", "images"])
def test_a_folder_of_pictures_suggests_running_colmap(tmp_path, load, folder):
    (tmp_path / folder).mkdir(exist_ok=True)
    Image.new("RGB", (4, 4)).save(tmp_path / folder / "a.JPG", format="JPEG")
    with pytest.raises(SceneError, match="holds pictures but no camera poses: run COLMAP"):
        load(tmp_path)


def test_a_file_is_no_scene(tmp_path, load):
    (tmp_path / "a.ply").write_text("ply")
    with pytest.raises(SceneError, match="is a file, not a scene folder"):
        load(tmp_path / "a.ply")


def test_a_path_that_is_not_there_mentions_the_data_folder(tmp_path, load, monkeypatch):
    monkeypatch.delenv("SPLATWIZARD_DATA", raising=False)
    with pytest.raises(SceneError, match=r"scene 'nowhere/garden' is not there.*SPLATWIZARD_DATA is not set"):
        load("nowhere/garden")
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path))
    with pytest.raises(SceneError, match=f"nor is {tmp_path}/nowhere/garden"):
        load("nowhere/garden")


def test_dataset_and_scene_are_found_below_the_data_folder(colmap_folder, load, monkeypatch):
    colmap_folder.root = colmap_folder.root.parent / "mipnerf360" / "garden"
    colmap_folder.write()
    monkeypatch.setenv("SPLATWIZARD_DATA", str(colmap_folder.root.parent.parent))
    scene = load("mipnerf360/garden")
    assert scene.name == "garden"
    assert scene.protocol.id == "mipnerf360/images/r-1/every8/black/pp-center/q8"


def test_a_collection_brings_its_published_split(colmap_folder, load, monkeypatch):
    colmap_folder.root = colmap_folder.root.parent / "bungee" / "rome"
    colmap_folder.names = [f"{i:03d}.png" for i in range(40)]
    colmap_folder.write()
    monkeypatch.setenv("SPLATWIZARD_DATA", str(colmap_folder.root.parent.parent))
    assert len(load("bungee/rome").test) == 31
    assert len(load("bungee/rome", split="every8").test) == 5


def test_a_folder_with_both_layouts_can_be_read_as_either(colmap_folder, load):
    root = colmap_folder.write()
    (root / "transforms_train.json").write_text('{"frames": []}')
    with pytest.raises(SceneError, match="could be any of: blender, colmap"):
        load(root)
    assert len(load(f"colmap:{root}").train) == 8


def test_demo_is_the_procedural_scene_even_beside_a_folder_of_that_name(colmap_folder, load, monkeypatch):
    colmap_folder.root = colmap_folder.root.parent / "demo"
    colmap_folder.write()
    monkeypatch.chdir(colmap_folder.root.parent)
    assert load("demo").protocol.dataset == "demo"
    assert load("./demo").protocol.dataset == "colmap"


def test_a_forced_family_that_does_not_fit_says_what_it_misses(tmp_path, load):
    with pytest.raises(SceneError, match=r"no sparse/0/cameras\.bin \(or \.txt\); run COLMAP first"):
        load(f"colmap:{tmp_path}")
    with pytest.raises(SceneError, match=r"transforms_train\.json is missing"):
        load(f"blender:{tmp_path}")


@pytest.mark.parametrize("spec", ["x" * 5000, "nobody/" + "x" * 5000, "~no-such-user/garden", "a\0b"])
@pytest.mark.parametrize("root", [None, "there"])
def test_a_name_that_no_folder_can_have_is_one_clear_line(monkeypatch, tmp_path, spec, root):
    if root is None:
        monkeypatch.delenv("SPLATWIZARD_DATA", raising=False)
    else:
        monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path))
    with pytest.raises(SceneError, match="is not there"):
        load_scene(spec, SceneOptions(), Plugins(monkeypatch))
