"""A package of an older contract is told which one that is, what changed, and where the page about it is."""

from __future__ import annotations

import importlib
import json
import re
from importlib.resources import files
from pathlib import Path

import pytest
from bad_neighbours import hook, metric
from strangers_site import Site

import splatwizard_core.plugins
from splatwizard_core.plugins.migration import written_for

ROOT = Path(__file__).resolve().parents[1]
MOVED = json.loads(files(splatwizard_core.plugins).joinpath("moved.json").read_text("utf-8"))
OLD = ROOT / "tests" / "golden" / "packages_0_1" / "sw_third_party"
ANY = ["splatwizard-core>=0.1"]
SAID = "it is written for splatwizard-core 0.1, here is "
BROKEN = {
    "sw-old-import": ("from splatwizard_core.coding.protocols import Quantizer", ANY,
                      "splatwizard_core.coding.protocols is now splatwizard_core.api (docs/migration.md)"),
    "sw-old-hook": (hook("register_commands", "pass").replace("registry", "cli"), ANY, "hooks have changed"),
    "sw-old-hook-call": (hook("register_metrics", "registry.add_metric('x')"), ANY, "hooks have changed"),
}  # fmt: skip
"""Distribution -> its plugin module, what it requires, and what is said besides SAID."""


def test_the_page_has_the_table_and_every_new_place_is_there():
    page = (ROOT / "docs" / "migration.md").read_text("utf-8")
    assert dict(re.findall(r"^\| `([\w.]+)` \| `([\w.]+)` \|$", page, re.MULTILINE)) == MOVED
    for old, new in MOVED.items():
        importlib.import_module(new)
        with pytest.raises(ModuleNotFoundError):
            importlib.import_module(old)


@pytest.mark.parametrize(
    ("requirement", "contract"),
    [
        ("splatwizard-core>=0.1", "0.1"),
        ("splatwizard_core==0.1.*", "0.1"),
        ("splatwizard-core<0.2,>=0.1.3", "0.1"),
        ("splatwizard-core>=0.2,<0.3", "0.2"),
        ("splatwizard-core>=0.3,<0.4", ""),
        ("splatwizard-core", ""),
        ("numpy>=0.1", ""),
        ("not a requirement ==", ""),
    ],
)
def test_the_contract_is_the_lowest_release_that_is_taken(requirement, contract):
    assert written_for([requirement]) == contract


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    site = Site(tmp_path_factory.mktemp("old"))
    for name, (source, requires, _) in BROKEN.items():
        site.install(name, source, requires=requires)
    site.install("sw-old-bound", "", requires=["splatwizard-core>=0.1,<0.2"])
    site.install("sw-old-works", metric("works", "sw_old_works"), requires=ANY)
    site.install("sw-new-fails", "1 / 0", requires=["splatwizard-core>=0.3,<0.4"])
    site.install("sw-unreadable", "", requires=["this is == no requirement"])
    install(site, "sw-third", (OLD / "plugin.py").read_text(), (OLD / "method.py").read_text(), ANY)
    return site


def install(site: Site, name: str, plugin: str, method: str, requires: list[str]) -> None:
    """The example of 0.1, as it was or moved."""
    module = name.replace("-", "_")
    plugin = plugin.replace("sw_third_party.method", f"{module}_method")
    site.install(name, plugin, requires=requires, **{f"{module}_method": method})


@pytest.fixture(scope="module")
def listed(site: Site):
    return site.listed()


@pytest.mark.parametrize("name", BROKEN)
def test_one_that_cannot_be_registered_is_told_its_contract(listed, name):
    error = listed.of(name)["error"]
    assert SAID in error
    assert BROKEN[name][2] in error
    assert "\n" not in error


def test_a_bound_below_this_core_is_told_as_its_contract(listed):
    error = listed.of("sw-old-bound")["error"]
    assert error.startswith("it is written for splatwizard-core 0.1 (splatwizard-core<0.2,>=0.1), here is ")
    assert error.endswith("(docs/migration.md): pip install --upgrade sw-old-bound")


def test_nothing_is_said_of_one_that_works_or_fails_of_itself(listed):
    assert listed.working["sw-old-works"] == {"metric works"}
    assert listed.of("sw-new-fails")["error"] == "ZeroDivisionError: division by zero"


def test_a_requirement_that_cannot_be_read_is_the_reason(listed):
    assert "requires 'this is == no requirement', which cannot be read" in listed.of("sw-unreadable")["error"]


def test_the_example_of_0_1_is_told_where_its_imports_are_and_works_with_them_replaced(site, tmp_path):
    done = site.sw("schedule", "opacity-prune", check=False)
    assert done.returncode == 2
    assert SAID in done.stderr
    assert "splatwizard_core.experiments is now splatwizard_core.api (docs/migration.md)" in done.stderr
    moved = Site(tmp_path)
    texts = [re.sub(r"from splatwizard_core\.[\w.]+ import", "from splatwizard_core.api import", path.read_text())
             for path in (OLD / "plugin.py", OLD / "method.py")]  # fmt: skip
    install(moved, "sw-third", *texts, ["splatwizard-core>=0.3,<0.4"])
    steps = ("--set", "iterations=2", "--set", "base_iterations=2")
    done = moved.sw("run", "--method", "opacity-prune", "--scene", "demo:tiny", *steps, "--out", "out")
    assert "decoded in a fresh process" in done.stderr


def test_a_distribution_that_hides_one_of_ours_is_told(tmp_path):
    site = Site(tmp_path)
    info = tmp_path / "sw_3dgs-9.9.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: sw-3dgs\nVersion: 9.9\n")
    site.install("sw-brings", "")
    (tmp_path / "sw_brings-0.1.dist-info" / "RECORD").write_text("sw_codecs/__init__.py,,\nsw_brings.py,,\n")
    done = site.sw("list-plugins", "--json")
    assert re.search(r"sw-3dgs 9\.9 in \S+ hides sw-3dgs \S+ in \S+: remove the wrong one", done.stderr)
    (brings,) = (row for row in json.loads(done.stdout)["plugins"] if row["distribution"] == "sw-brings")
    assert brings["error"].startswith("it brings the module sw_codecs, that of sw-codecs")
