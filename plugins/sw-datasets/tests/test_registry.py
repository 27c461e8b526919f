"""Registries of data sets: the one that ships with the package, those of other packages, and what a lab adds."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path

import pytest
from sw_datasets.downloads.presence import dataset_state, read_receipt, scene_presence
from sw_datasets.downloads.registry import PUBLIC, REGISTRY_VARIABLE, DataSet, load_registry, parse_registry
from sw_datasets.families import BENCHMARKS
from sw_datasets.plugin import register_downloads

from splatwizard_core.errors import ConfigError, UserInputError
from splatwizard_core.plugins.registry import Registry as PluginRegistry

OWN = """
[dataset.lab]
title = "The lab's own"
scenes = ["desk", "shelf"]
needs = ["images", "sparse"]
[[dataset.lab.file]]
name = "lab.zip"
url = "http://localhost/lab.zip"
size = 1234
sha256 = "%s"
""" % ("AB" * 32)


@pytest.fixture(autouse=True)
def no_own_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(REGISTRY_VARIABLE, raising=False)


def published() -> list[DataSet]:
    """Downloads that this package lists itself; others list more."""
    return [dataset for dataset in load_registry().values() if dataset.registry == PUBLIC]


@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_family_of_the_benchmark_is_listed_with_its_scenes(name: str):
    family, dataset = BENCHMARKS[name], load_registry()[name]
    assert set(dataset.scenes) <= set(family.scenes)
    assert dataset.prefix == family.prefix
    assert dataset.views == family.views
    listed = {scene for entry in load_registry().values() for scene in entry.scenes}
    assert set(family.scenes) <= listed


def test_every_scene_can_be_fetched_from_some_file():
    for dataset in published():
        assert dataset.homepage
        assert dataset.files
        held = {scene for file in dataset.files for scene in dataset.scenes_of(file)}
        assert held == set(dataset.scenes)


def test_nothing_is_pinned_that_no_publisher_states():
    """The publishers give neither checksums nor exact sizes; an entry that gains one must come with its source."""
    for dataset in published():
        for file in dataset.files:
            assert (file.sha256, file.size) == (None, None)


def test_google_drive_is_for_people():
    files = [file for dataset in published() for file in dataset.files]
    assert all(file.by_hand for file in files if "drive.google" in file.url)
    assert all(re.search(r"\.(zip|tar\.gz)$", file.url) for file in files if not file.by_hand)


def test_an_own_registry_adds_and_replaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "own.toml"
    path.write_text(OWN + OWN.replace("dataset.lab", "dataset.db").replace("lab's own", "mirror"))
    monkeypatch.setenv(REGISTRY_VARIABLE, str(path))
    known = load_registry()
    assert known["lab"].registry == known["db"].registry == str(path)
    assert (known["lab"].files[0].size, known["lab"].files[0].sha256) == (1234, "ab" * 32)
    assert known["db"].title == "The mirror"
    assert known["tandt"].registry == "public"
    assert load_registry(path)["lab"] == known["lab"]


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(UserInputError, match="did you mean 'mipnerf360'"):
        load_registry()["mipnerf36"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('url = "http://localhost/lab.zip"', 'url = "file:///etc/passwd"', r"dataset\.lab\.file\.0\.url"),
        ('url = "http://localhost/lab.zip"', "", r"dataset\.lab\.file\.0\.url: Field required"),
        ("AB" * 32, "AB", r"dataset\.lab\.file\.0\.sha256"),
        ("size = 1234", "size = -1", r"dataset\.lab\.file\.0\.size"),
        ('name = "lab.zip"', 'name = "../lab.zip"', "is no name of a folder or file"),
        ('"desk"', '"../../desk"', "is no name of a folder or file"),
        ('"desk"', '".hidden"', "is no name of a folder or file"),
        ('"desk"', '"shelf"', "a scene is listed twice"),
        ('needs = ["images"', 'needs = ["/images"', "must be a path inside the scene"),
        ('title = "The lab\'s own"', "", r"dataset\.lab\.title"),
        ("size = 1234", 'size = 1234\nscenes = ["chair"]', "holds scene 'chair'"),
        ("size = 1234", 'size = 1234\ninto = "x"', "'into' is for data sets without scenes"),
        ("size = 1234", "siez = 1234", r"dataset\.lab\.file\.0\.siez"),
        ("[dataset.lab]", 'id = "x"\n[dataset.lab]', "'id' is out of place"),
        ("[dataset.lab]", '[dataset."../lab"]', "is no name of a folder or file"),
        ("[dataset.lab]", "[dataset.lab", "is not valid TOML"),
    ],
)
def test_a_mistake_in_a_registry_is_named_with_its_key(old: str, new: str, message: str):
    assert old in OWN
    with pytest.raises(ConfigError, match=message) as caught:
        parse_registry(OWN.replace(old, new).encode(), "own.toml")
    assert str(caught.value).startswith("own.toml")
    assert "\n" not in str(caught.value).strip()


def test_a_registry_that_is_not_there_is_named_with_its_variable(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(REGISTRY_VARIABLE, "/nowhere/own.toml")
    with pytest.raises(ConfigError, match=r"/nowhere/own\.toml \(\$SPLATWIZARD_DATA_REGISTRY\) cannot be read"):
        load_registry()


def test_the_registry_that_the_page_shows_is_valid():
    page = (Path(__file__).parents[3] / "docs" / "datasets.md").read_text("utf-8")
    (shown,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (dataset,) = parse_registry(shown.encode(), "docs/datasets.md")
    assert (dataset.id, dataset.scenes) == ("atrium", ("stairs", "fountain"))


def test_what_is_on_disk_is_told_by_names(tmp_path: Path):
    lab = parse_registry(OWN.encode(), "own.toml")[0]
    states = []
    for made in (None, "lab/desk/images", "lab/desk/sparse", "lab/shelf/images", "lab/shelf/sparse"):
        if made is not None:
            (tmp_path / made).mkdir(parents=True)
        scenes = [scene_presence(tmp_path, lab, name) for name in lab.scenes]
        states.append((*(scene.state for scene in scenes), dataset_state(tmp_path, lab, scenes)))
    assert states == [
        ("missing", "missing", "missing"),
        ("partly", "missing", "partly"),
        ("present", "missing", "partly"),
        ("present", "partly", "partly"),
        ("present", "present", "present"),
    ]
    assert scene_presence(tmp_path, lab, "desk").path == tmp_path / "lab" / "desk"


def test_the_two_archives_of_bungee_fill_one_folder(tmp_path: Path):
    known = load_registry()
    for name, scene in (("bungee", "rome"), ("bungee_original", "56Leonard")):
        assert scene_presence(tmp_path, known[name], scene).path == tmp_path / "bungee" / scene


@pytest.mark.parametrize("where", ["dtu/scan24", "dtu/24", "DTU/scan24"])
def test_scenes_are_found_where_the_loader_finds_them(where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from splatwizard_core.scene.locate import locate
    from splatwizard_core.tooling import load_plugins

    (tmp_path / where / "images").mkdir(parents=True)
    found = scene_presence(tmp_path, load_registry()["dtu"], "24")
    assert (found.path, found.state) == (tmp_path / where, "partly")
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path))
    assert locate("dtu/24", load_plugins().datasets)[0] == found.path


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b'{"archive": 1, "files": {}}', b"\xff", b"[" * 100_000])
def test_a_damaged_receipt_is_none(content: bytes, tmp_path: Path):
    (tmp_path / ".fetched").mkdir()
    (tmp_path / ".fetched" / "garden.json").write_bytes(content)
    assert read_receipt(tmp_path, "garden") is None


def test_the_registry_is_read_without_torch():
    program = (
        "import sys\nfrom sw_datasets.downloads.presence import scene_presence\n"
        "from sw_datasets.downloads.registry import load_registry\nload_registry()\nprint('torch' in sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=True,
        env={**os.environ, "SW_PLUGINS": "datasets"},  # what another package registers may be heavy
    )  # fmt: skip
    assert done.stdout.split() == ["False"]


LAB = """
[dataset.lab]
title = "The lab"
scenes = ["desk"]

[dataset.tandt]
title = "not ours"
"""


@pytest.fixture
def another_package(monkeypatch: pytest.MonkeyPatch):
    """another_package(content): a package beside this one that registers such a registry."""

    def register(content: Callable[[], bytes]) -> None:
        downloads = PluginRegistry("download")
        register_downloads(downloads)
        downloads._owner = ("another-package", "1.0", True)
        downloads.add("another", "another_package:data", summary="")
        module = types.ModuleType("another_package")
        module.data = content  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "another_package", module)
        plugins = types.SimpleNamespace(downloads=downloads)
        monkeypatch.setattr("sw_datasets.downloads.registry.load_plugins", lambda: plugins)

    return register


def test_another_package_can_say_what_can_be_fetched(another_package, caplog):
    another_package(LAB.encode)
    known = load_registry()
    assert (known["lab"].title, known["lab"].registry) == ("The lab", "another")
    assert (known["tandt"].title, known["tandt"].registry) == ("Tanks & Temples", "public")
    assert "data set 'tandt' of another-package is left out: 'public' lists one of that name" in caplog.text


@pytest.mark.parametrize("content", [b"[", None, SystemExit, ZeroDivisionError])
def test_a_package_whose_registry_cannot_be_read_harms_no_other(another_package, caplog, content):
    def data() -> bytes:
        if isinstance(content, type):
            raise content("no good")
        return content

    another_package(data)
    assert "mipnerf360" in load_registry()
    assert "downloads 'another' of another-package cannot be read" in caplog.text
