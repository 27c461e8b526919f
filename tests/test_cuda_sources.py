"""Every package's CUDA kernels compile, wherever there is a CUDA compiler: a GPU is not needed, nor torch's headers."""

from __future__ import annotations

import re
import subprocess

import pytest
from sw_doctor.building import resolve_module
from sw_doctor.declared_modules import declared_modules

from splatwizard_core.plugins import load_plugins
from splatwizard_native import find_nvcc, toolchain

DECLARED = [resolve_module(target) for target in declared_modules(load_plugins())]
MODULES = [*DECLARED, *(module.cuda for module in DECLARED if module.cuda is not None)]
SOURCES = [(module, source) for module in MODULES for source in module.cuda_sources if source.endswith(".cu")]
NVCC = find_nvcc()


def test_there_are_cuda_sources_to_compile():
    assert {module.name for module, _ in SOURCES} >= {"sw_rasterizers_cuda", "sw_codecs_cuda", "sw_anchors_cuda"}


@pytest.fixture(scope="module")
def checked() -> list[str]:
    """Options that check a source's device code and make none: the language, and only declared headers."""
    told = subprocess.run([str(NVCC), "--help"], capture_output=True, text=True, check=True).stdout
    return ["-fdevice-syntax-only"] if "-fdevice-syntax-only" in told else ["-Xcicc", "-O0"]


@pytest.mark.skipif(NVCC is None, reason="no CUDA compiler on this machine")
@pytest.mark.parametrize(("module", "source"), SOURCES, ids=lambda x: x if isinstance(x, str) else x.name)
def test_it_compiles_without_a_torch_header(module, source, checked, tmp_path):
    path = module._root() / source
    # Of inline assembly only code that is made tells whether it is any: then to PTX, that nobody optimised.
    made = ["-Xcicc", "-O0"] if re.search(r"\basm\b", path.read_text("utf-8")) else checked
    command = [
        str(NVCC), "-std=c++20", "-arch=sm_90", *made, "-isystem", str(toolchain.SHARED_INCLUDE),
        "-Werror", "all-warnings", "-ptx", str(path), "-o", str(tmp_path / "out.ptx"),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
