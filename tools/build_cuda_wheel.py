"""Build the distribution of all CUDA kernels for one major version of CUDA, for any torch and any Python.

    python tools/build_cuda_wheel.py [--out dist]

Needs hatchling, torch (any), a C++ compiler ($CXX) and nvcc, whose major version N names it: `splatwizard-cudaN`, which
pins the versions of the packages that it was built from. The loader finds its libraries where they are of the same
sources as the packages. $TORCH_CUDA_ARCH_LIST: compute capabilities; else all of ARCHITECTURES that nvcc knows, the
last one also as PTX, for later GPUs. Two builds by one compiler give the same bytes.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import build_wheels

ARCHITECTURES = ("7.5", "8.0", "8.6", "8.9", "9.0", "10.0", "12.0")
PROJECT = """[build-system]
requires = ["hatchling>=1.24"]
build-backend = "hatchling.build"

[project]
name = "splatwizard-cuda{major}"
version = "{version}"
description = "CUDA kernels of Splatwizard's packages, compiled for CUDA {major}"
license = "MIT"
authors = [{{ name = "The Splatwizard authors" }}]
requires-python = ">=3.10"
dependencies = {dependencies}

[tool.hatch.build.targets.wheel]
packages = ["src/splatwizard_cuda{major}"]

[tool.hatch.build.targets.wheel.hooks.custom]
"""


def offered(nvcc: str) -> list[str]:
    """Those of ARCHITECTURES that a compiler knows, the last one with PTX."""
    known = subprocess.run([nvcc, "--list-gpu-arch"], capture_output=True, text=True, check=True).stdout.split()
    found = [a for a in ARCHITECTURES if f"compute_{a.replace('.', '')}" in known]
    return [*found[:-1], f"{found[-1]}+PTX"]


def version_of(package: Path) -> str:
    """The version that a package's pyproject.toml tells."""
    found = re.search(r'^version = "(.+)"$', (package / "pyproject.toml").read_text("utf-8"), re.MULTILINE)
    assert found is not None, package
    return found[1]


def modules() -> Iterator[tuple[Path, build_wheels.Module]]:
    """Packages with modules for GPUs, and these."""
    for package in build_wheels.packages([]):
        for module in build_wheels.declared(package):
            if module.cuda_sources:
                yield package, module


def write_project(folder: Path, major: int, versions: dict[str, str]) -> Path:
    """Write a project that pins packages (name -> version); the folder of its libraries."""
    pins = json.dumps([f"{name}=={version}" for name, version in sorted(versions.items())])
    text = PROJECT.format(major=major, version=versions["splatwizard-native"], dependencies=pins)
    (folder / "pyproject.toml").write_text(text, encoding="utf-8")
    hook = build_wheels.ROOT / "splatwizard-native" / "hatch_build.py"
    (folder / "hatch_build.py").write_bytes(hook.read_bytes())
    inside = folder / "src" / f"splatwizard_cuda{major}"
    (inside / "prebuilt").mkdir(parents=True)
    (inside / "__init__.py").write_text(
        f'"""CUDA kernels for CUDA {major}; splatwizard_native finds them."""\n', "utf-8"
    )
    return inside / "prebuilt"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=build_wheels.ROOT / "dist", help="folder of the wheel")
    out = parser.parse_args().out
    sys.path[:0] = [str(package / "src") for package in build_wheels.packages([])]
    from splatwizard_native import cuda_toolkit

    nvcc = cuda_toolkit.find_nvcc()
    version = None if nvcc is None else cuda_toolkit.nvcc_version(nvcc)
    if nvcc is None or version is None:
        sys.exit("there is no nvcc that runs: point CUDA_HOME at a CUDA toolkit")
    os.environ.setdefault("TORCH_CUDA_ARCH_LIST", ";".join(offered(nvcc)))
    if "--compress-mode" in subprocess.run([nvcc, "--help"], capture_output=True, text=True, check=True).stdout:
        os.environ.setdefault("NVCC_APPEND_FLAGS", "--compress-mode=size")
    machine, found = platform.machine(), list(modules())
    versions = {package.name: version_of(package) for package, _ in found}
    with tempfile.TemporaryDirectory() as scratch:
        into = write_project(Path(scratch), version[0], versions)
        libraries = [build_wheels.placed(module, machine, into) for _, module in found]
        for library in libraries:
            print(f"{library.name} {library.stat().st_size:,}", flush=True)
        out.mkdir(parents=True, exist_ok=True)
        wheel = build_wheels.packed(Path(scratch), build_wheels.platform_of(libraries, machine), out)
    print(f"{wheel.name} {wheel.stat().st_size:,}")


if __name__ == "__main__":
    main()
