"""Who imports whom, read from the syntax trees of the workspace: modules, rooms of the core, and packages."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
NATIVE = ROOT / "splatwizard-native" / "src" / "splatwizard_native"
"""The base below the core."""
CORE = ROOT / "splatwizard-core" / "src" / "splatwizard_core"
_PLUGINS = sorted(p for p in ROOT.glob("plugins/*/src/sw_*") if (p / "__init__.py").is_file())
PACKAGES = [p for p in _PLUGINS if p.name.replace("_", "-") == p.parents[1].name]
"""Import packages of the workspace above the core."""
FORWARDING = [p for p in _PLUGINS if p not in PACKAGES]
"""Old import paths that a package brings besides, for one release."""
STRANGERS = sorted(p for folder in ("examples", "tests/plugins") for p in ROOT.glob(f"{folder}/*/src/sw_*"))
"""Packages as third parties would write them."""


def imported(path: Path, *, types: bool = False) -> tuple[str, ...]:
    """Dotted names of all modules that a file imports, at any depth.

    types: also those under `if TYPE_CHECKING:`
    """
    return tuple(name for name, for_types in _imports(path) if types or not for_types)


@cache
def _imports(path: Path) -> list[tuple[str, bool]]:
    """Imported names, and whether each stands under `if TYPE_CHECKING:`."""
    found: list[tuple[str, bool]] = []

    def visit(node: ast.AST, for_types: bool) -> None:
        if isinstance(node, ast.Import):
            found.extend((alias.name, for_types) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.extend((f"{node.module}.{alias.name}", for_types) for alias in node.names)
        typing_only = isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
        for child in ast.iter_child_nodes(node):
            if not isinstance(child, ast.expr):
                visit(child, for_types or (typing_only and child not in node.orelse))

    visit(ast.parse(path.read_text(encoding="utf-8")), False)
    return found


def files_of(package: Path) -> list[Path]:
    return sorted(package.rglob("*.py"))


def module_name(path: Path, package: Path) -> str:
    parts = path.relative_to(package.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def module_files() -> Mapping[str, Path]:
    """Module of the workspace -> its file."""
    return {module_name(p, package): p for package in (NATIVE, CORE, *PACKAGES) for p in files_of(package)}


@cache
def module_graph(*, types: bool = False) -> Mapping[str, frozenset[str]]:
    """Module -> the modules of the workspace that it imports when it runs, function-level imports included.

    types: also those that it imports for a type checker alone
    """
    files = module_files()

    def home(name: str) -> str | None:
        """The module that a dotted name is or lies in."""
        while name and name not in files:
            name = name.rpartition(".")[0]
        return name or None

    return {
        module: frozenset(
            found for name in imported(path, types=types) if (found := home(name)) is not None and found != module
        )
        for module, path in files.items()
    }


def reached(modules: Iterable[str], *, but: Callable[[str], bool] = lambda _: False) -> set[str]:
    """The modules outside core and native that these import, directly or through others, and these themselves.

    but: modules whose imports are followed no further than to others that it says yes to
    """
    graph, found, waiting = module_graph(), set[str](), list(modules)
    while waiting:
        module = waiting.pop()
        if module in found or module.startswith("splatwizard_"):
            continue
        found.add(module)
        waiting += [other for other in graph[module] if not but(module) or but(other)]
    return found


def is_fast(module: str) -> bool:
    """Whether a module lies in a folder `fast`."""
    return "fast" in module_files()[module].parts[:-1]


def lines_of(module: str) -> int:
    """Lines of a module."""
    return len(module_files()[module].read_text(encoding="utf-8").splitlines())


@dataclass(frozen=True)
class Closure:
    """What a reader must follow to read a module: its imports, and theirs, outside core and native.

    modules, lines  without those in folders `fast`, and without modules of at most 5 lines
    fast            lines in folders `fast` that are reached
    """

    modules: int
    lines: int
    fast: int

    @classmethod
    def of(cls, module: str) -> Closure:
        """That of a module."""
        sizes = {each: lines_of(each) for each in reached([module], but=is_fast)}
        sizes = {each: lines for each, lines in sizes.items() if lines > 5}
        plain = [lines for each, lines in sizes.items() if not is_fast(each)]
        return cls(len(plain), sum(plain), sum(sizes.values()) - sum(plain))

    def __str__(self) -> str:
        return f"{self.modules} modules, {self.lines:,} lines, +{self.fast:,} in fast/"


def circles(graph: Mapping[str, frozenset[str]]) -> list[list[str]]:
    """The groups of nodes that reach each other (strongly connected components of more than one), by Tarjan."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph[node]:
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            at = stack.index(node)
            group = stack[at:]
            del stack[at:]
            if len(group) > 1:
                found.append(sorted(group))

    for node in graph:
        if node not in index:
            visit(node)
    return found


def longest_chain(graph: Mapping[str, frozenset[str]]) -> list[str]:
    """The longest path of imports in a graph without circles."""

    @cache
    def from_(node: str) -> tuple[str, ...]:
        return (node, *max((from_(other) for other in graph[node]), key=len, default=()))

    return list(max((from_(node) for node in graph), key=len))


def project(package: Path) -> dict[str, object]:
    """The [project] table of an import package."""
    table: dict[str, object] = tomllib.loads((package.parents[1] / "pyproject.toml").read_text("utf-8"))["project"]
    return table


def needed(distribution: str) -> list[str]:
    """A distribution of ours and those of ours that it requires, directly or through others."""
    ours = {str(project(package)["name"]): package for package in (NATIVE, CORE, *PACKAGES)}
    found: list[str] = []
    waiting = [distribution]
    while waiting:
        name = waiting.pop()
        if name in ours and name not in found:
            found.append(name)
            waiting += sorted(declared_dependencies(ours[name]))
    return found


def declared_dependencies(package: Path) -> set[str]:
    """Distributions that a package lists as dependencies, without extras."""
    listed = project(package)["dependencies"]
    assert isinstance(listed, list)
    return {re.split(r"[ <>=!~\[(;]", line, maxsplit=1)[0] for line in listed}
