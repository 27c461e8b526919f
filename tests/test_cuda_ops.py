"""Faults of torch ops on CUDA that only a GPU would show, read from the sources: headers, definitions, calls."""

from __future__ import annotations

import ast
import re
from collections import Counter
from pathlib import Path

import pytest
import torch
from sw_doctor.building import resolve_module
from sw_doctor.declared_modules import declared_modules

from splatwizard_core.plugins import load_plugins

ROOT = Path(__file__).resolve().parents[1]
DECLARED = [resolve_module(target) for target in declared_modules(load_plugins())]
MODULES = [module.cuda for module in DECLARED if module.cuda is not None]
DEFINED = re.compile(r'm\.def\(\s*((?:"[^"]*"\s*)+)(,?)')
OF_NAMESPACE = re.compile(r"TORCH_LIBRARY(?:_FRAGMENT|_IMPL)?\((\w+)")
SOURCES = ("plugins/*/src/**/*.py", "plugins/*/tests/**/*.py", "splatwizard-*/**/*.py", "benchmarks/*.py", "tests/*.py")


def included(path: Path) -> set[Path]:
    """The files that one includes by a relative path, and those that they include."""
    found, new = set[Path](), [path]
    while new:
        each = new.pop()
        names = re.findall(r'^\s*#include "([^"]+)"', each.read_text("utf-8"), re.MULTILINE)
        inside = {(each.parent / name).resolve() for name in names} - found
        found |= inside
        new += inside
    return found


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.name)
def test_every_header_is_declared(module):
    declared = {path.resolve() for path in module._files()}
    for source in (*module.sources, *module.cuda_sources):
        assert included(module._root() / source) <= declared, source


def ops() -> dict[str, torch._C.FunctionSchema]:
    """The schema of each op by namespace.name."""
    found = {}
    for module in [module for module in MODULES if not module.face]:
        text = "\n".join((module._root() / source).read_text("utf-8") for source in module.sources)
        (namespace,) = set(OF_NAMESPACE.findall(text))
        assert text.count("TORCH_LIBRARY(") == 1, module.name
        defined = [("".join(re.findall('"([^"]*)"', literals)), bool(own)) for literals, own in DEFINED.findall(text)]
        schemas = [torch._C.parse_schema(schema) for schema, _ in defined]
        implemented = re.findall(r'm\.impl\("(\w+)"', text)
        implemented += [schema.name for schema, (_, own) in zip(schemas, defined, strict=True) if own]
        assert Counter(implemented) == Counter(schema.name for schema in schemas), module.name
        found |= {f"{namespace}.{schema.name}": schema for schema in schemas}
    return found


OPS = ops()
NAMESPACES = {name.partition(".")[0] for name in OPS}


def op_of(node: ast.AST) -> str | None:
    """The namespace.name that an expression stands for: `torch.ops.x.y`."""
    if not isinstance(node, ast.Attribute):
        return None
    of = ast.unparse(node.value)
    namespace = of.removeprefix("torch.ops.")
    return f"{namespace}.{node.attr}" if namespace in NAMESPACES and of not in NAMESPACES else None


def test_calls_fit_the_definitions():
    """Starred arguments stand for any number."""
    used = set()
    for path in [path for pattern in SOURCES for path in ROOT.glob(pattern)]:
        text = path.read_text("utf-8")
        if "torch.ops." not in text:
            continue
        for node in ast.walk(ast.parse(text)):
            if (name := op_of(node)) is not None:
                assert name in OPS, f"{path}: {name}"
                used.add(name)
            if isinstance(node, ast.Call) and (name := op_of(node.func)) is not None:
                arguments = OPS[name].arguments
                starred = sum(isinstance(each, ast.Starred) for each in node.args)
                given = len(node.args) - starred + len(node.keywords)
                needed = sum(not argument.has_default_value() for argument in arguments)
                assert (0 if starred else needed) <= given <= len(arguments), f"{path}:{node.lineno}: {name}"
                assert {each.arg for each in node.keywords} <= {argument.name for argument in arguments}
    assert used == set(OPS)
