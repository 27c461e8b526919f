"""Headers of plain C faces are C, and Python takes their structs for what a C compiler does; no source needs torch."""

from __future__ import annotations

import ctypes
import re
import subprocess
from pathlib import Path

import pytest
from sw_doctor.building import resolve_module
from sw_doctor.declared_modules import declared_modules

from splatwizard_core.plugins import load_plugins
from splatwizard_native import CompilerMissingError, NativeModule, find_compiler, toolchain
from splatwizard_native.face import OPERATION, read_structs, structure

ROOT = Path(__file__).resolve().parents[1]


def faces() -> list[NativeModule]:
    declared = [resolve_module(target) for target in declared_modules(load_plugins())]
    return [module for each in declared for module in (each, each.cuda) if module is not None]


@pytest.mark.parametrize("module", faces(), ids=lambda module: module.name)
def test_the_header_is_c_with_the_structs_that_python_reads(module, tmp_path):
    try:
        compiler = find_compiler()
    except CompilerMissingError as error:
        pytest.skip(str(error))
    header = module.face_header
    calls = {f"{operation}_call" for _, operation in OPERATION.findall(header)}
    lines = [header]
    for name, fields in read_structs(header).items():
        made = structure(name, fields, call=name in calls)
        lines.append(f'_Static_assert(sizeof({name}) == {ctypes.sizeof(made)}, "{name}");')
        lines += [
            f'_Static_assert(offsetof({name}, {f.name}) == {getattr(made, f.name).offset}, "{name}.{f.name}");'
            for f in fields
        ]
    source = tmp_path / "face.c"
    source.write_text("\n".join(lines) + "\n", encoding="utf-8")
    options = ["-x", "c", "-std=c11", "-Wall", "-Wno-pragma-once-outside-header", "-fsyntax-only"]
    command = [*compiler, *options, "-isystem", str(toolchain.SHARED_INCLUDE), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_no_native_source_reads_a_header_of_torch_or_python():
    forbidden = re.compile(r'#\s*include\s*[<"](torch/|ATen/|c10/|pybind11/|Python\.h)|\bTORCH_LIBRARY')
    packages = [path for pattern in ("splatwizard-*/src", "plugins/*/src") for path in ROOT.glob(pattern)]
    sources = [p for package in packages for p in package.rglob("*") if p.suffix in (".h", ".cpp", ".cu", ".cuh")]
    assert len(sources) > 100
    assert [str(path.relative_to(ROOT)) for path in sources if forbidden.search(path.read_text("utf-8"))] == []


@pytest.mark.parametrize("module", faces(), ids=lambda module: module.name)
def test_every_header_is_declared(module):
    declared = {path.resolve() for path in module._files()}
    for source in (*module.sources, *module.kernels, *module.cuda_sources):
        assert included(module._root() / source) <= declared, source


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
