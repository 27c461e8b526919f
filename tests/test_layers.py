"""Who may import whom: knowledge flows downward, and no plugin is known by name."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CORE = ROOT / "splatwizard-core" / "src" / "splatwizard_core"
PLUGINS = sorted(p for folder in ("plugins", "examples", "tests/plugins") for p in ROOT.glob(f"{folder}/*/src/sw_*"))

BELOW_ALL = {"errors", "files", "progress", "streams", "memory", "cores"}
"""Single modules that know no room."""
ROOMS = {
    "plugins": set(),
    "native": set(),
    "scene": {"plugins"},
    "gaussians": {"scene"},
    "rendering": {"gaussians", "scene", "plugins", "builtin"},
    "training": {"rendering", "gaussians", "scene", "native"},
    "coding": {"gaussians", "scene"},
    "evaluation": {"rendering", "gaussians", "scene", "plugins"},
    "testing": {"rendering", "gaussians", "scene"},
    "experiments": {"training", "coding", "evaluation", "rendering", "gaussians", "scene", "plugins", "native"},
    "cli": {
        "experiments", "training", "coding", "evaluation", "rendering", "gaussians", "scene", "plugins", "native",
    },
    "builtin": {"plugins"},
    "__main__": {"cli"},
    **{module: set() for module in BELOW_ALL},
}  # fmt: skip
"""Room -> the rooms that it may import when it runs. What only a type checker reads is free."""


def imported(path: Path) -> Iterator[str]:
    """Dotted names of all modules that a file imports, at any depth but under `if TYPE_CHECKING:`."""

    def visit(node: ast.AST) -> Iterator[str]:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        typing_only = isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
        for child in node.orelse if typing_only else ast.iter_child_nodes(node):
            yield from visit(child)

    return visit(ast.parse(path.read_text(encoding="utf-8")))


def files_of(package: Path) -> list[Path]:
    return sorted(package.rglob("*.py"))


def room_of(path: Path) -> str:
    return path.relative_to(CORE).parts[0].removesuffix(".py")


def test_every_room_is_in_the_table():
    assert {room_of(p) for p in files_of(CORE)} - {"__init__"} == set(ROOMS)


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_a_room_imports_only_what_lies_below(room):
    upward = []
    for path in files_of(CORE / room) or [CORE / f"{room}.py"]:
        for name in imported(path):
            package, _, rest = name.partition(".")
            allowed = {room, "__version__", ""} | BELOW_ALL | ROOMS[room]
            if package == "splatwizard_core" and rest.partition(".")[0] not in allowed:
                upward.append(f"{path.relative_to(CORE)} imports {name}")
    assert upward == []


def test_the_table_has_no_circle():
    below: set[str] = set()
    while len(below) < len(ROOMS):
        ready = {room for room, uses in ROOMS.items() if uses <= below} - below
        assert ready, f"these import each other: {sorted(set(ROOMS) - below)}"
        below |= ready


def test_the_core_imports_no_plugin():
    found = [(p.name, m) for p in files_of(CORE) for m in imported(p) if m.startswith("sw_")]
    assert found == []


@pytest.mark.parametrize("package", PLUGINS, ids=lambda p: p.name)
def test_a_plugin_imports_no_sibling(package):
    modules = [(p.name, m.split(".")[0]) for p in files_of(package) for m in imported(p)]
    assert modules, "no import was found: the test looks in the wrong place"
    assert [(f, m) for f, m in modules if m.startswith("sw_") and m != package.name] == []


def test_imports_are_found_wherever_they_stand(tmp_path):
    """The finder itself: in functions, in `else` branches, but not for type checkers alone."""
    source = """
        import a.b, c
        from d.e import f
        def function():
            from g import h
        if TYPE_CHECKING:
            import no
        else:
            import i
        try:
            import j
        except ImportError:
            import k
    """
    path = tmp_path / "module.py"
    path.write_text("if True:\n" + source)
    assert list(imported(path)) == ["a.b", "c", "d.e.f", "g.h", "i", "j", "k"]


@pytest.mark.parametrize("arguments", [[], ["--help"], ["list-plugins"]], ids=["import", "help", "list-plugins"])
def test_what_must_be_quick_imports_no_torch(arguments):
    program = f"""
import sys
import splatwizard_core

status = 0
if {arguments}:
    from splatwizard_core.cli.main import main
    status = main({arguments})
print("torch" in sys.modules, file=sys.stderr)
sys.exit(status)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.split()[-1] == "False"
    assert bool(done.stdout) == bool(arguments)
