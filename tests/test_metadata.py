"""What an index shows of each package, and what a wheel must carry: licence, authors, classifiers, addresses, types."""

from __future__ import annotations

import email
import re
import zipfile
from pathlib import Path

import pytest
from fresh_environments import ROOT, WORKSPACE, build_wheels

from splatwizard_core import __version__

building = pytest.importorskip("hatchling.build", reason="hatchling, which builds wheels, is not installed")
LICENSE = (ROOT / "LICENSE").read_text("utf-8")
CITATION = (ROOT / "CITATION.cff").read_text("utf-8")


@pytest.mark.parametrize("project", WORKSPACE, ids=lambda path: path.name)
def test_the_metadata_of_a_wheel_is_complete(project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(project)
    folder = building.prepare_metadata_for_build_wheel(str(tmp_path))
    told = email.message_from_string((tmp_path / folder / "METADATA").read_text("utf-8"))
    assert told["Name"] == project.name
    assert told["License-Expression"] == "MIT"
    assert told.get_all("License-File") == ["LICENSE"]
    assert told["Author"]
    assert told["Summary"]
    assert {"Typing :: Typed", "Intended Audience :: Science/Research"} <= set(told.get_all("Classifier", []))
    assert not [name for name in told.get_all("Classifier", []) if name.startswith("License ::")], "SPDX says it"
    addresses = [line.partition(", ")[2] for line in told.get_all("Project-URL", [])]
    assert addresses
    assert all(re.fullmatch(r"https://\S+", address) for address in addresses)
    assert (project / "LICENSE").read_text("utf-8") == LICENSE
    packages = [path.parent for path in project.glob("src/*/__init__.py")]
    assert project.name.replace("-", "_") in [package.name for package in packages]
    assert all((package / "py.typed").is_file() for package in packages)


def test_a_wheel_carries_the_licence_and_the_types(tmp_path: Path):
    (wheel,) = build_wheels([ROOT / "plugins" / "sw-3dgs"], tmp_path)
    names = zipfile.ZipFile(wheel).namelist()
    assert f"sw_3dgs-{__version__}.dist-info/licenses/LICENSE" in names
    assert "sw_3dgs/py.typed" in names


def test_the_citation_is_of_this_version_and_licence():
    fields = dict(re.findall(r'^([a-z-]+): "?([^"\n]+)"?$', CITATION, re.M))
    assert fields["cff-version"] == "1.2.0"
    assert fields["version"] == __version__
    assert fields["license"] == "MIT"
    assert re.search(r"^authors:\n  - name: \S", CITATION, re.M)


def test_the_bibtex_of_the_docs_is_what_the_citation_says():
    page = (ROOT / "docs" / "questions.md").read_text("utf-8")
    software, paper = re.findall(r"@\w+\{[\w-]+,\n(.*?)\n\}", page, re.S)
    fields = dict(re.findall(r'^([a-z-]+): "?([^"\n]+)"?$', CITATION, re.M))
    told = dict(re.findall(r"(\w+) += \{+([^{}]+)\}+", software))
    assert (told["title"], told["version"], told["date"], told["license"]) == (
        fields["title"], fields["version"], fields["date-released"], fields["license"]
    )  # fmt: skip
    assert f"name: {told['author']}\n" in CITATION
    eprint = dict(re.findall(r"(\w+) += \{+([^{}]+)\}+", paper))["eprint"]
    assert f"arXiv:{eprint}" in CITATION
