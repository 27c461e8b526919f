"""A package as of 0.2: the example of a third party, unchanged, is installed beside this release and runs."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
import math
import shutil
import zipfile
from pathlib import Path

import pytest
from fresh_environments import ROOT, build_wheels
from strangers_site import Site

pytestmark = pytest.mark.pipeline

PACKAGE = ROOT / "tests" / "golden" / "packages_0_2" / "sw-third-party"
UNCHANGED = "6fe18339dd33df47"
PROMISED = (PACKAGE.parent / "promised.txt").read_text("utf-8").split()
PYTEST = "import sys, pytest; sys.exit(pytest.main(sys.argv[1:]))"
SHORT = ("--set", "pretrained.iterations=40", "--set", "iterations=10")


def files_of_the_package() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*") if path.is_file() and "__pycache__" not in path.parts)


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """The package's wheel, unpacked as pip does, beside all of ours; its metadata asks for 0.2."""
    site = Site(tmp_path_factory.mktemp("beside"))
    (wheel,) = build_wheels([PACKAGE], tmp_path_factory.mktemp("of_0_2"))
    with zipfile.ZipFile(wheel) as content:
        content.extractall(site.folder)
    return site


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", PROMISED)
def test_what_its_docs_promised_still_imports(name):
    """The names of docs/plugins.md as of 0.2: of the core's face, and of libraries."""
    found, parts = None, name.split(".")
    for end in range(len(parts), 0, -1):
        with contextlib.suppress(ModuleNotFoundError):
            found = importlib.import_module(".".join(parts[:end]))
            break
    for part in parts[end:]:
        found = getattr(found, part)
    assert found is not None


def test_it_is_as_it_was():
    content = hashlib.sha256()
    for path in files_of_the_package():
        content.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    assert content.hexdigest()[:16] == UNCHANGED
    assert '"splatwizard-core>=0.2,<0.3"' in (PACKAGE / "pyproject.toml").read_text("utf-8")


def test_it_runs_and_its_file_decodes(beside, tmp_path):
    listed = beside.listed().of("sw-third-party")
    assert listed["error"] is None
    assert [each["name"] for each in listed["provides"]] == ["opacity-prune"]
    beside.sw("run", "--method", "opacity-prune", "--scene", "demo:tiny", "--out", str(tmp_path / "out"), *SHORT)
    (path,) = (tmp_path / "out").glob("**/metrics.json")
    record = json.loads(path.read_text())
    assert math.isfinite(record["metrics"]["psnr"]["mean"])
    decoded = json.loads(beside.sw("decode", str(path.parent / "scene.swz"), "--json").stdout)
    assert decoded["digest"] == record["file"]["digest"]


def test_its_own_tests_pass_and_say_which_import_path_is_old(beside, tmp_path):
    shutil.copytree(PACKAGE / "tests", tmp_path / "tests")
    done = beside.run("-c", PYTEST, "-q", "--import-mode=importlib", "-p", "no:cacheprovider", "tests", cwd=tmp_path)
    assert done.returncode == 0, done.stdout
    assert "DeprecationWarning: sw_finetuning is sw_gaussians.finetune now" in done.stdout


def test_pip_tells_that_its_metadata_forbids_this_release(beside):
    """As 0.2 told authors to write it; so pip installs it only with --no-deps, or before the upgrade."""
    done = beside.run("-m", "pip", "check")
    assert "sw-third-party 0.1.0 requires sw-finetuning, which is not installed" in done.stdout
    assert "sw-third-party 0.1.0 has requirement splatwizard-core<0.3,>=0.2, but you have" in done.stdout
