"""The choice of a family for what the user typed, by what its entry declares and by what it detects."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from splatwizard_core.errors import SceneError
from splatwizard_core.plugins.registry import Registry
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene
from splatwizard_core.scene.scene import Protocol


class Families:
    """A registry of families that tell by whom and from where a scene was asked; `add` declares their fields."""

    def __init__(self, module: ModuleType) -> None:
        self.module, self.datasets = module, Registry("dataset")

    def add(self, name: str, score: float = 0.0, **declared) -> None:
        def load(path: Path, options: SceneOptions) -> SimpleNamespace:
            return SimpleNamespace(reader=name, place=path, protocol=Protocol(name))

        setattr(self.module, name, SimpleNamespace(detect=lambda path: score, load=load))
        self.datasets.add(name, f"{self.module.__name__}:{name}", summary="", **declared)

    def load(self, spec: object) -> tuple[str, Path, str]:
        scene = load_scene(str(spec), SceneOptions(), self)
        return scene.reader, scene.place, scene.protocol.dataset


@pytest.fixture
def families(monkeypatch, tmp_path):
    module = ModuleType("made_up_families")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path))
    return Families(module)


@pytest.fixture
def catalogue(monkeypatch):
    """Packages of ours that are not installed: none, until a test adds kind -> name -> package."""
    found: dict[str, dict[str, str]] = {"dataset": {}}
    monkeypatch.setattr("splatwizard_core.plugins.catalogue.catalogue", lambda: found)
    monkeypatch.setattr("splatwizard_core.scene.loading.catalogue", lambda: found)
    return found


def test_a_procedural_family_is_asked_by_its_name_alone(families, tmp_path, monkeypatch):
    families.add("made", procedural=True)
    families.add("folders", 0.5)
    (tmp_path / "made" / "x").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert families.load("made") == ("made", Path("made"), "made")
    assert families.load("made:small") == ("made", Path("small"), "made")
    assert families.load("./made") == ("folders", Path("made"), "folders")
    assert families.load("made/x")[0] == "folders"


def test_a_scene_is_found_by_the_folders_and_the_prefix_that_its_family_declares(families, tmp_path):
    families.add("lab", scenes=["24"], folders=["lab_v2"], prefix="scan")
    (tmp_path / "Lab_v2" / "scan24").mkdir(parents=True)
    assert families.load("lab/24") == ("lab", tmp_path / "Lab_v2" / "scan24", "lab")
    with pytest.raises(SceneError, match=r"'lab/25' is not there, nor is .*Lab_v2/25: In .*Lab_v2: scan24"):
        families.load("lab/25")


def test_a_folder_of_ones_own_gives_its_name_to_the_protocol_but_not_to_a_published_scene(families, tmp_path):
    (tmp_path / "town" / "square").mkdir(parents=True)
    families.add("layout", 0.5)
    assert families.load("town/square")[2] == "town"
    families.add("published", 0.9, scenes=["square"])
    assert families.load("town/square")[2] == "published"


def test_what_was_looked_for_is_what_the_families_declare(families, tmp_path):
    families.add("first", looks_for="poses.txt (First)", without_poses="run First on {path}")
    families.add("second")
    with pytest.raises(SceneError, match=r"Looked for poses\.txt \(First\); families asked: first, second$"):
        families.load(tmp_path)
    (tmp_path / "a.png").touch()
    with pytest.raises(SceneError, match=f"holds pictures but no camera poses: run First on {tmp_path}. Looked for"):
        families.load(tmp_path)


def test_the_ways_to_name_a_scene_are_those_that_are_installed(families):
    with pytest.raises(SceneError, match=r"give a scene folder or dataset/scene$"):
        families.load("/nowhere")
    families.add("made", procedural=True)
    with pytest.raises(SceneError, match=r"give a scene folder, dataset/scene, or made$"):
        families.load("/nowhere")


@pytest.mark.parametrize("spec", ["lab/24", "lab:somewhere", "lab"])
def test_a_scene_of_a_package_that_is_not_there_is_answered_with_its_name(families, catalogue, tmp_path, spec):
    catalogue["dataset"]["lab"] = "sw-no-such-package"
    families.add("layout", 0.5)
    (tmp_path / "lab" / "24").mkdir(parents=True)
    with pytest.raises(SceneError, match="pip install sw-no-such-package"):
        families.load(spec)
    assert families.load(tmp_path / "lab" / "24")[0] == "layout"


def test_a_folder_that_nothing_reads_names_the_packages_that_might(families, catalogue, tmp_path):
    catalogue["dataset"] |= {"lab": "sw-no-such-package", "other": "sw-no-such-package"}
    with pytest.raises(SceneError, match=r"families asked: none; more are read by sw-no-such-package: pip install sw"):
        families.load(tmp_path)


@pytest.mark.parametrize("error", [ZeroDivisionError, SystemExit])
def test_a_family_whose_detection_raises_harms_nothing_else(families, tmp_path, caplog, error):
    def detect(path: Path) -> float:
        raise error("no good")

    families.add("good", 0.5)
    families.add("bad")
    families.module.bad.detect = detect
    assert families.load(tmp_path)[0] == "good"
    assert "data set 'bad' of" in caplog.text
    assert "no good" in caplog.text
