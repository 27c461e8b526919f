"""Imports of a package, read from its sources: nothing is imported."""

from __future__ import annotations

import ast
import importlib.util
from collections.abc import Iterator
from pathlib import Path

BLOCKS = (ast.stmt, ast.ExceptHandler, ast.match_case)


def imports_of(package: str) -> dict[str, str]:
    """Return the dotted name of every module that a package or module imports when it runs -> the file that does."""
    spec = importlib.util.find_spec(package)
    places = [] if spec is None else [Path(each) for each in spec.submodule_search_locations or []]
    files = [file for place in places for file in sorted(place.rglob("*.py"))]
    if spec is not None and not places and spec.origin:
        files = [Path(spec.origin)]
    found: dict[str, str] = {}
    for file in files:
        for name in _imported(ast.parse(file.read_text("utf-8")), package):
            found.setdefault(name, file.name)
    return found


def _imported(node: ast.AST, package: str) -> Iterator[str]:
    """Names below a node, at any depth but under `if TYPE_CHECKING:`; relative imports are the package's own."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        yield from [package] if node.level else (f"{node.module}.{alias.name}" for alias in node.names)
    typing_only = isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
    children = node.orelse if isinstance(node, ast.If) and typing_only else ast.iter_child_nodes(node)
    for child in children:
        if isinstance(child, BLOCKS):  # no expression imports
            yield from _imported(child, package)
