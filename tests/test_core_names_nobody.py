"""The core knows no method: no name of a method, rasterizer, codec, coder or distribution of ours is a string in it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from import_graph import CORE, PACKAGES, files_of

from splatwizard_core.plugins.catalogue import catalogue

KINDS = ("method", "rasterizer", "pruner", "quantizer", "entropy model", "context model", "coder", "dataset")
OWN = {name for kind in KINDS for name in catalogue()[kind]}
PLAIN_WORDS = {
    "count": "a word of messages and of rasterizer results",
    "depth": "a field of RenderResult",
    "range": "a form of a plan",
    "columns": "a word of tables",
    "opacity": "a property of a .ply",
    "removal": "a kind of score that rasterizers sum up",
    "standard": "a word",
    "uniform": "a word",
}
"""Names that are plain words as well: alone they say nothing, so only whole sentences could give them away."""


def strings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and text of every string constant that is no docstring, pieces of f-strings included."""
    documentation = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    # A string that stands alone documents the name above it.
    documentation |= {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documentation:
            yield node.lineno, node.value


def names_in(text: str) -> set[str]:
    """Names of ours that a string is, or mentions as a word of its own."""
    words = set(re.findall(r"[A-Za-z0-9][\w-]*", text))
    return {name for name in OWN if name == text or name in words} - set(PLAIN_WORDS)


@pytest.mark.parametrize("path", files_of(CORE), ids=lambda p: str(p.relative_to(CORE)))
def test_no_string_of_the_core_names_something_of_ours(path):
    distributions = {package.name.replace("_", "-") for package in PACKAGES} | {p.name for p in PACKAGES}
    found = []
    for line, text in strings(ast.parse(path.read_text("utf-8"))):
        named = names_in(text) | {d for d in distributions if re.search(rf"\b{re.escape(d)}\b", text)}
        if named or re.search(r"\bsw-(?=\W|$)|\bsw_(?=\W|$)", text):
            found.append(
                f"{path.relative_to(CORE)}:{line}: {text!r} names {', '.join(sorted(named)) or 'a prefix of ours'}"
            )
    assert found == []


def test_names_are_found(tmp_path: Path):
    source = (
        '"""hac in a docstring"""\nx = "hac"\ny = f"of {x} in sw-hac"\n"""hac beside it"""\nz = "octree positions"\n'
    )
    found = [(line, names_in(text)) for line, text in strings(ast.parse(source)) if names_in(text)]
    assert found == [(2, {"hac"}), (5, {"octree"})]
