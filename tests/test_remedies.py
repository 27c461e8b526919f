"""Advice to install something: every command that the code can print is collected, and works where it is read."""

from __future__ import annotations

import ast
import functools
import re
import shlex
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from splatwizard_core.plugins import remedies
from splatwizard_core.plugins.catalogue import is_ours
from splatwizard_core.plugins.remedies import COMMAND, as_installed

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = [ROOT / "splatwizard-native", ROOT / "splatwizard-core", *sorted((ROOT / "plugins").iterdir())]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted(ROOT.glob("*/README.md")),
         *sorted(ROOT.glob("plugins/*/README.md"))]  # fmt: skip
UNBOUND = "sw-hac"
"""In place of a name that is known when the message is made."""


def projects() -> dict[str, dict]:
    """Distribution -> its table [project]."""
    files = [folder / "pyproject.toml" for folder in PACKAGES if (folder / "pyproject.toml").is_file()]
    tables = [tomllib.loads(file.read_text("utf-8"))["project"] for file in files]
    return {canonicalize_name(table["name"]): table for table in tables}


def texts_of(tree: ast.AST, constants: dict[str, str]) -> list[str]:
    """Every string of a module, values of its own constants put in, and a distribution for what is not known."""
    inner = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            found.append("".join(_part(each, constants) for each in node.values))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inner:
            found.append(node.value)
    return found


def _part(node: ast.expr, constants: dict[str, str]) -> str:
    if isinstance(node, ast.Constant):
        return str(node.value)
    assert isinstance(node, ast.FormattedValue)
    return constants.get(node.value.id, UNBOUND) if isinstance(node.value, ast.Name) else UNBOUND


def constants_of(tree: ast.Module) -> dict[str, str]:
    return {
        target.id: node.value.value
        for node in tree.body if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
        for target in node.targets if isinstance(target, ast.Name) and isinstance(node.value.value, str)
    }  # fmt: skip


@functools.cache
def collected() -> dict[str, list[str]]:
    """Command as the code has it -> the modules that print it."""
    found: dict[str, list[str]] = {}
    for folder in PACKAGES:
        for file in sorted((folder / "src").rglob("*.py")):
            source = file.read_text("utf-8")
            if "install" not in source:
                continue
            tree = ast.parse(source)
            for text in texts_of(tree, constants_of(tree)):
                for match in COMMAND.finditer(text):
                    if " -e " in match[0]:  # of a folder that the message names
                        continue
                    found.setdefault(match[0], []).append(str(file.relative_to(ROOT)))
    return found


@pytest.fixture
def from_here(advice_as_installed, monkeypatch: pytest.MonkeyPatch) -> None:
    """The core is installed from this checkout, editable."""
    monkeypatch.setattr(remedies, "_origin", lambda: (ROOT / "splatwizard-core", True))
    monkeypatch.chdir(ROOT)


@pytest.fixture
def from_wheels(advice_as_installed, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    wheel = tmp_path / "the wheels" / "splatwizard_core-0.2.0-py3-none-any.whl"
    wheel.parent.mkdir()
    monkeypatch.setattr(remedies, "_origin", lambda: (wheel, False))
    monkeypatch.setattr(remedies, "pip", lambda: "pip")
    return wheel.parent


def test_what_the_code_can_print_is_collected():
    found = collected()
    assert len(found) >= 25
    assert {"pip install 'sw-geometry[mesh]'", "pip install 'sw-view[viser]'", "pip install sw-hac"} <= set(found)


def test_every_command_for_ours_names_folders_and_extras_that_are_there(from_here):
    known, ours = projects(), 0
    for command, places in collected().items():
        words = shlex.split(as_installed(command))
        for path in [after for word, after in pairwise(words) if word == "-e"]:
            folder, _, extras = path.partition("[")
            ours += 1
            assert (ROOT / folder / "pyproject.toml").is_file(), f"{command} in {places}"
            project = known[Path(folder).name]
            for extra in filter(None, extras.rstrip("]").split(",")):
                assert extra in project["optional-dependencies"], f"{command} in {places}"
        words = [word for before, word in pairwise(["", *words]) if before != "-e"]
        left = [word for word in words if re.fullmatch(r"sw-[\w-]+|splatwizard-\w+", word)]
        assert not left, f"{command} in {places} names {left}, which no index has"
    assert ours >= 20


def test_what_others_publish_is_something_that_a_package_of_ours_declares():
    tables = projects().values()
    lists = [table.get("dependencies", []) for table in tables]
    lists += [lines for table in tables for lines in table.get("optional-dependencies", {}).values()]
    known = {canonicalize_name(Requirement(line).name) for lines in lists for line in lines}
    for command, places in collected().items():
        for word in shlex.split(command.removeprefix("pip install ")):
            named = re.match(r"[A-Za-z0-9][\w.-]*", word)
            if named is not None and not is_ours(named[0]):
                known_here = canonicalize_name(named[0]) in known | {"torch", "torchvision"}
                assert known_here, f"{command} in {places}"
            if named is not None:
                break  # the sentence may go on


@pytest.mark.slow
def test_pip_takes_every_command_of_a_checkout(from_here):
    paths = {path for command in collected() for path in re.findall(r"-e '?([^\s']+)", as_installed(command))}
    words = [word for path in sorted(paths) for word in ("-e", path)]
    options = ["--dry-run", "--no-deps", "--no-index", "--no-build-isolation"]
    done = subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, *words],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("told", "wanted"),
    [
        ("needs Open3D: pip install 'sw-geometry[mesh]'", "needs Open3D: PIP install -e 'plugins/sw-geometry[mesh]'"),
        ("(pip install 'sw-gsplat[gsplat]')", "(PIP install -e 'plugins/sw-gsplat[gsplat]')"),
        ("comes with sw-kit: pip install sw-kit", "comes with sw-kit: PIP install -e plugins/sw-kit"),
        ("pip install sw-3dgs, or not", "PIP install -e plugins/sw-3dgs, or not"),
        ("pip install 'sw-hac>=0.1' (as the file says)", "PIP install -e plugins/sw-hac (as the file says)"),
        ("pip install 'sw-hac>=99.0'", "git -C . pull && PIP install -e plugins/sw-hac"),
        ("pip install --upgrade splatwizard-core", "git -C . pull && PIP install -e splatwizard-core"),
        ("pip install --force-reinstall --no-deps sw-hac", "PIP install --force-reinstall --no-deps -e plugins/sw-hac"),
        ("pip install torch -c constraints.txt", "PIP install torch -c constraints.txt"),
        ("pip install av and go on", "PIP install av and go on"),
        ("nothing to install", "nothing to install"),
    ],
)
def test_a_checkout_is_installed_from_its_folders(told, wanted, from_here, monkeypatch):
    monkeypatch.setattr(remedies, "pip", lambda: "PIP")
    assert as_installed(told) == wanted
    assert as_installed(as_installed(told)) == wanted or "PIP" not in wanted


def test_what_a_package_needs_of_ours_comes_with_it(from_here, monkeypatch):
    monkeypatch.setattr(remedies, "installed_version", lambda name: name in ("splatwizard-core", "splatwizard-native"))
    found = set(re.findall(r"plugins/(sw-[\w-]+)", as_installed("pip install sw-hac-plus")))
    assert {"sw-hac-plus", "sw-anchors", "sw-codecs", "sw-rasterizers"} <= found
    every = set(re.findall(r"plugins/(sw-[\w-]+)", as_installed("pip install 'splatwizard-core[all]'")))
    assert every == {folder.name for folder in (ROOT / "plugins").iterdir() if (folder / "pyproject.toml").is_file()}


def test_wheels_are_looked_for_where_the_core_came_from(from_wheels):
    assert shlex.split(as_installed("pip install 'sw-geometry[mesh]'")) == [
        "pip", "install", "--find-links", str(from_wheels), "sw-geometry[mesh]"
    ]  # fmt: skip


def test_an_installation_of_unknown_origin_is_told_what_to_name(advice_as_installed, monkeypatch):
    monkeypatch.setattr(remedies, "_origin", lambda: None)
    monkeypatch.setattr(remedies, "pip", lambda: "pip")
    assert as_installed("pip install sw-kit") == (
        "pip install --find-links WHEELS 'sw-kit' (WHEELS: the folder of the wheels that splatwizard-core came from)"
    )


def test_pages_give_no_advice_that_needs_an_index_of_ours():
    wrong = [
        f"{page.relative_to(ROOT)}: {found}"
        for page in PAGES
        for found in re.findall(r"pip install '?(?:sw|splatwizard)-[\w-]+\S*", page.read_text("utf-8"))
        if is_ours(re.split(r"[\[='>]", found.removeprefix("pip install ").strip("'`"))[0])
    ]
    assert not wrong


def test_the_small_torch_of_the_readme_is_the_pinned_one():
    pinned = re.search(r"^torch==(\S+)$", (ROOT / "constraints.txt").read_text("utf-8"), re.M)
    assert pinned is not None
    assert f"CPU build of torch=={pinned[1]}" in (ROOT / "README.md").read_text("utf-8")
