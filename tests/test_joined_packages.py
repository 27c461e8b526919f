"""Packages of 0.2 that are part of others now: their import paths, requirements on them, and old ones left behind."""

from __future__ import annotations

import importlib
import json
import re
import sys

import pytest
from bad_neighbours import metric
from import_graph import FORWARDING, ROOT, files_of
from strangers_site import Site

from splatwizard_core.plugins import loading, versions
from splatwizard_core.plugins.catalogue import superseded

PAGE = (ROOT / "docs" / "migration.md").read_text("utf-8")
WERE = {
    "sw_finetuning": ("distillation", "fine_tuning", "importance", "pruning", "volume"),
    "sw_formats": ("codecs", "methods"),
    "sw_ray": ("executor", "work"),
    "sw_render": (
        "agreement", "bake_command", "colors", "command", "drawing", "exr", "films", "map_files", "maps", "modes",
        "trajectory", "video", "views",
    ),
    "sw_viewer": (
        "after_run", "command", "entries", "exhibits", "frames", "live", "looks", "packing", "page_file",
        "shown_cameras", "shown_gaussians", "viewer", "visitor",
    ),
}  # fmt: skip
"""Import package of 0.2 -> its modules, without those that only register."""


def test_every_forwarded_package_is_known_and_on_the_page():
    assert {package.name for package in FORWARDING} == set(WERE)
    assert all([path.name for path in files_of(package)] == ["__init__.py"] for package in FORWARDING)
    rows = dict(re.findall(r"^\| `(sw-[\w-]+)` \| `(sw-[\w-]+)`", PAGE, re.M))
    assert rows == superseded()
    assert {name.replace("-", "_") for name in superseded()} == set(WERE)


@pytest.mark.parametrize("package", WERE)
def test_the_old_import_path_gives_the_modules_of_the_new_one_and_says_so(package, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.warns(
        DeprecationWarning, match=rf"^{package} is sw_[\w.]+ now; .*0\.4 \(docs/migration\.md\)$"
    ) as told:
        importlib.import_module(package)
    assert len(told) == 1
    home = superseded()[package.replace("_", "-")].replace("-", "_")
    for name in WERE[package]:
        module = importlib.import_module(f"{package}.{name}")
        assert module.__name__.startswith(f"{home}.")
        assert module is importlib.import_module(module.__name__)
        assert getattr(importlib.import_module(package), name) is module
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module(f"{package}.never_there")
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """A stranger's package of 0.2, and two of ours that were left from 0.2."""
    site = Site(tmp_path_factory.mktemp("joined"))
    uses = "from sw_finetuning.pruning import removal_count\n" + metric("kept", "sw_of_0_2")
    needs = [f"{name}>=0.2,<0.3" for name in ("splatwizard-core", "sw-gaussians", "sw-finetuning")]
    site.install("sw-of-0-2", uses, requires=needs)
    site.install("sw-finetuning", "raise SystemExit('an old module was imported')")
    (site.folder / "sw_finetuning.py").unlink()  # its files are the new package's
    site.install("sw-render", "raise SystemExit('an old module was imported')", key="render")
    (site.folder / "sw_render.py").unlink()
    return site


def test_what_was_written_for_the_old_packages_works_beside_what_is_left_of_them(site):
    done = site.sw("list-plugins", "--json")
    rows = {row["distribution"]: row for row in json.loads(done.stdout)["plugins"]}
    assert rows["sw-of-0-2"]["error"] is None
    assert {(each["kind"], each["name"]) for each in rows["sw-of-0-2"]["provides"]} == {("metric", "kept")}
    assert not {"sw-finetuning", "sw-render"} & rows.keys()
    lines = [line for line in done.stderr.splitlines() if "is not used" in line]
    assert len(lines) == 2
    for name, home in (("sw-finetuning", "sw-gaussians"), ("sw-render", "sw-view")):
        (line,) = (
            line for line in lines if f"{name} 0.1 in {site.folder} is not used, it is part of {home} now" in line
        )
        assert re.search(rf"uninstall it, then \S*pip install --force-reinstall --no-deps .*{home}", line)


def test_plugins_are_chosen_by_their_old_names_too(site):
    names = site.listed(SW_PLUGINS="render,sw-formats").names
    assert names == {"splatwizard-core", "sw-view", "sw-interchange"}


def test_a_requirement_on_an_old_package_names_the_new_one_where_that_is_gone(tmp_path, monkeypatch):
    info = tmp_path / "sw_of_0_2-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: sw-of-0-2\nRequires-Dist: sw-ray<0.3,>=0.2\n")
    dist = importlib.metadata.Distribution.at(info)
    assert loading.unmet_requirement(dist) is None

    def gone(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(loading, "_installed_version", gone)
    told = "needs sw-ray, which is part of sw-bench now and not installed: pip install sw-bench"
    assert loading.unmet_requirement(dist) == told


def test_what_an_old_package_made_is_told_with_the_new_name(plugins):
    now = importlib.metadata.version("sw-gaussians")
    said = versions.changes(plugins, {"sw-finetuning": "0.2.0", "sw-gaussians": now})
    assert said == [f"sw-finetuning 0.2.0, now part of sw-gaussians {now}"]


@pytest.fixture
def plugins():
    from splatwizard_core.plugins import load_plugins

    return load_plugins()
