"""Importers and exporters by the suffix of a file, and guarded: what breaks in one names its distribution."""

from pathlib import Path

import pytest

from splatwizard_core.errors import PluginError, SceneError, UserInputError
from splatwizard_core.plugins.manager import PluginManager
from splatwizard_core.plugins.registry import Registry


def read_nothing(path: Path) -> None:
    raise KeyError("means")


def read_badly(path: Path) -> None:
    raise SceneError(f"{path}: not a scene")


@pytest.fixture
def plugins() -> PluginManager:
    found = PluginManager([])
    for owner, foreign, entries in (
        ("sw-ours", False, {"ply": ".ply", "packed": ".packed.ply", "bad": ".bad", "by-name": ""}),
        ("theirs", True, {"ply2": ".ply", "ply3": ".my.packed.ply", "their-bad": ".tbad"}),
    ):
        found.importers._owner = (owner, "1.0", foreign)
        for name, suffix in entries.items():
            target = "read_badly" if name == "bad" else "read_nothing"
            found.importers.add(name, f"{__name__}:{target}", summary="", suffix=suffix)
    return found


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("a.ply", "ply"), ("A.PLY", "ply"), ("a.packed.ply", "packed"), ("a.my.packed.ply", "packed"),
        ("a.tbad", "their-bad"), ("a.swz", None), ("ply", None), ("", None),
    ],
)  # fmt: skip
def test_the_longest_suffix_counts_and_ours_first(plugins, path, name):
    assert plugins.importers.of_suffix(Path(path)) == name


def test_a_registry_without_suffixes_has_none():
    assert Registry("metric").of_suffix("a.ply") is None


def test_an_importer_that_breaks_is_named_and_an_error_for_users_passes(plugins, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, __name__, sys.modules.get(__name__) or type(sys)(__name__))
    monkeypatch.setattr(sys.modules[__name__], "read_nothing", read_nothing, raising=False)
    monkeypatch.setattr(sys.modules[__name__], "read_badly", read_badly, raising=False)
    with pytest.raises(PluginError, match=r"importer 'their-bad' of theirs 1\.0 failed: KeyError: 'means'"):
        plugins.read_gaussians(Path("x.tbad"))
    with pytest.raises(UserInputError, match="not a scene"):
        plugins.read_gaussians(Path("x.bad"))
