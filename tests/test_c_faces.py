"""Headers of plain C faces are C, and Python takes their structs for what a C compiler does."""

from __future__ import annotations

import ctypes
import subprocess

import pytest
from sw_doctor.building import resolve_module
from sw_doctor.declared_modules import declared_modules

from splatwizard_core.plugins import load_plugins
from splatwizard_native import CompilerMissingError, NativeModule, find_compiler, toolchain
from splatwizard_native.face import OPERATION, read_structs, structure


def faces() -> list[NativeModule]:
    declared = [resolve_module(target) for target in declared_modules(load_plugins())]
    return [module for each in declared for module in (each, each.cuda) if module is not None and module.face]


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
