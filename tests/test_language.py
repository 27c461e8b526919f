"""Docstrings begin with a verb or a noun: a reader learns in the first word whether a thing is done or described."""

from __future__ import annotations

import ast

import pytest
from import_graph import CORE, NATIVE, PACKAGES, ROOT, STRANGERS, files_of

QUESTIONS = {"What", "Who", "Whose", "How", "Where", "Which", "Why"}
FOLDERS = [NATIVE, CORE, *PACKAGES, *STRANGERS, ROOT / "benchmarks", ROOT / "tools"]


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda p: p.name)
def test_no_docstring_begins_with_a_question(folder):
    found = []
    for path in files_of(folder):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
                text = ast.get_docstring(node) or ""
                if text.partition(" ")[0] in QUESTIONS:
                    found.append(f"{path.relative_to(folder)}: {text.splitlines()[0]}")
    assert found == []
