"""The kernels of every module with a plain C face compile to WebAssembly, where `ziglang` is installed."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import pytest
from sw_doctor.building import resolve_module
from sw_doctor.declared_modules import declared_modules

from splatwizard_core.plugins import load_plugins
from splatwizard_native import toolchain

MODULES = [resolve_module(target) for target in declared_modules(load_plugins())]
# Loops of a library without `run` go on in the caller's thread, and WebAssembly has no other: it needs no pool.
SOURCES = [
    (module, source, is_kernel)
    for module in MODULES
    if module.name != "splatwizard_pool"
    for is_kernel, sources in ((False, module.sources), (True, module.kernels))
    for source in sources
]


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ziglang") is None, reason="ziglang is not installed")
@pytest.mark.parametrize(
    ("module", "source", "is_kernel"), SOURCES, ids=[f"{module.name}-{source}" for module, source, _ in SOURCES]
)
def test_it_compiles_to_webassembly(module, source, is_kernel, tmp_path):
    command = [
        sys.executable, "-m", "ziglang", "c++", "-target", "wasm32-wasi", "-std=c++20", "-O2",
        "-isystem", str(toolchain.SHARED_INCLUDE), *module.cflags, *(["-DSW_ARCH=arch_native"] if is_kernel else []),
        "-c", str(module._root() / source), "-o", str(tmp_path / "out.o"),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out.o").read_bytes()[:4] == b"\0asm"
