"""`sw new-plugin`: names, files, and what is refused."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from sw_kit import templates
from sw_kit.names import LONGEST, check_free, legal_names
from sw_kit.new_plugin import write
from sw_kit.templates import kinds, rendered

from splatwizard_core.api import UserInputError
from splatwizard_core.cli.main import main
from splatwizard_core.tooling import load_plugins

EXAMPLE = Path(__file__).parents[3] / "examples" / "sw-third-party"


def test_one_name_makes_all_others():
    names = legal_names("sw-opacity-prune2")
    assert (names.key, names.snake, names.package) == ("opacity-prune2", "opacity_prune2", "sw_opacity_prune2")
    assert (names.distribution, names.pascal) == ("sw-opacity-prune2", "OpacityPrune2")
    assert legal_names("opacity-prune2") == names


@pytest.mark.parametrize(
    ("name", "said"),
    [("My Method", "'my-method' is one"), ("a_b", "'a-b' is one"), ("3d", "a letter first"), ("", "no name"),
     ("sw-", "no name"), ("a--b", "single hyphens"), ("../up", "'up' is one"), ("x" * (LONGEST + 1), "at most")],
)  # fmt: skip
def test_a_name_that_is_not_legal_is_refused_with_one_that_is(name, said):
    with pytest.raises(UserInputError, match=said):
        legal_names(name)


@pytest.mark.parametrize(
    ("name", "kind", "said"),
    [("3dgs", "method", "a letter first"), ("kit", "method", "the plugin of sw-kit"),
     ("mesongs-never", "method", None), ("octree", "coder", "sw-codecs provides it"), ("psnr", "metric", "provides it"),
     ("run", "command", "splatwizard-core provides it")],
)  # fmt: skip
def test_a_name_that_is_taken_is_refused_with_its_owner(name, kind, said):
    if said is None:
        check_free(legal_names(name), kind, load_plugins())
        return
    with pytest.raises(UserInputError, match=said):
        check_free(legal_names(name), kind, load_plugins())


def test_a_package_of_ours_is_taken_whether_it_is_installed_or_not(monkeypatch):
    monkeypatch.setattr("sw_kit.names.importlib.metadata.requires", lambda _: ["sw-later>=0.2; extra == 'all'"])
    with pytest.raises(UserInputError, match="a package of Splatwizard itself"):
        check_free(legal_names("later"), "method", load_plugins())


def test_an_import_name_that_is_taken_is_refused(tmp_path, monkeypatch):
    (tmp_path / "sw_taken_module.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UserInputError, match="import name 'sw_taken_module' is taken"):
        check_free(legal_names("taken-module"), "method", load_plugins())


@pytest.mark.parametrize("kind", kinds())
def test_json_lists_what_was_written_and_nothing_else_is(kind, tmp_path, capsys):
    assert main(["new-plugin", "some-name", "--kind", kind, "--into", str(tmp_path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    folder = Path(told["folder"])
    assert sorted(told["files"]) == sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    assert list(tmp_path.iterdir()) == [folder]
    texts = "".join(path.read_text("utf-8") for path in folder.rglob("*") if path.is_file())
    for word in ("your-", "your_", "Your"):
        assert word not in texts
    assert {"pyproject.toml", "README.md", "LICENSE", ".github/workflows/test.yml"} <= set(told["files"])


def test_an_existing_folder_is_refused_and_left_alone(tmp_path, capsys):
    (tmp_path / "sw-some-name").mkdir()
    assert main(["new-plugin", "some-name", "--into", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert list((tmp_path / "sw-some-name").iterdir()) == []


def test_nothing_is_left_half_written(tmp_path, monkeypatch):
    monkeypatch.setattr("sw_kit.new_plugin.rendered", lambda *_: {"a.txt": "text", "b.txt": None})
    with pytest.raises(TypeError):
        write(tmp_path / "sw-some-name", kinds()["metric"], legal_names("some-name"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["x", "a-name-as-long-as-one-may-be"])
def test_what_is_written_passes_its_own_linter(name, tmp_path):
    for kind in kinds().values():
        write(tmp_path / kind.name, kind, legal_names(name))
    for arguments in (["check"], ["format", "--check"]):
        done = subprocess.run(
            [sys.executable, "-m", "ruff", *arguments, "--no-cache", str(tmp_path)], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stdout


def test_templates_state_the_versions_that_this_project_has():
    version = load_plugins().plugins[0].version
    for kind in kinds().values():
        ours = [line for line in kind.dependencies if line.startswith("sw-")]
        for line in (*ours, "splatwizard-core>=0.3,<0.4"):
            assert Requirement(line).specifier.contains(version), line
    assert '"splatwizard-core>=0.3,<0.4"' in (templates.ROOT / "common" / "pyproject.toml.tmpl").read_text()


def test_the_example_of_a_third_party_is_such_a_package():
    files = rendered(kinds()["post-training"], legal_names("third-party"))
    here = {path.relative_to(EXAMPLE).as_posix() for path in EXAMPLE.rglob("*") if path.is_file()}
    assert {path for path in here if "__pycache__" not in path and not path.startswith(".ruff")} == set(files)
    for path in here & {path for path in files if path.endswith(".py")}:
        ast.parse((EXAMPLE / path).read_text("utf-8"))
        assert "TODO" not in (EXAMPLE / path).read_text("utf-8"), path
