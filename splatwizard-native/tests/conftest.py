"""The package that tests of the loader compile, and their folder on the path, where importlib mode puts none."""

import shutil
import sys
from pathlib import Path

import pytest

from splatwizard_native import toolchain

sys.path.insert(0, str(Path(__file__).parent))

from native_package import Package, packages


@pytest.fixture
def package(tmp_path, monkeypatch) -> Package:
    folder = tmp_path / "src" / f"tiny_native_{next(packages)}"
    folder.mkdir(parents=True)
    monkeypatch.syspath_prepend(str(folder.parent))
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "cache"))
    for name in ("SPLATWIZARD_NATIVE", "SPLATWIZARD_BUILD_TIMEOUT", "CXX", "MAX_JOBS"):
        monkeypatch.delenv(name, raising=False)
    calls = tmp_path / "calls"
    real = next((found for name in toolchain.COMPILERS if (found := shutil.which(name))), None)
    if real is not None:
        wrapper = tmp_path / "counting-compiler"
        wrapper.write_text(f'#!/bin/sh\necho "$@" >> {calls}\nexec {real} "$@"\n')
        wrapper.chmod(0o755)
        monkeypatch.setenv("CXX", str(wrapper))
    return Package(folder, calls)
