"""Build the distribution of CUDA kernels for one major version of CUDA, for any torch and any Python.

    python tools/build_cuda_wheel.py [--out dist]

Needs a C++ compiler ($CXX) and nvcc, whose major version N names it: `splatwizard-cudaN`. It pins the versions of
the packages that it was built from; a library is taken where the sources of its package are the same.
$TORCH_CUDA_ARCH_LIST: compute capabilities; else all of ARCHITECTURES that nvcc knows, the last one also as PTX, for
later GPUs. Two builds by one compiler, in a folder of the same name, give the same bytes: nvcc names what is local to
a file by the file's path.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import os
import platform
import re
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import build_wheels

ARCHITECTURES = ("7.5", "8.0", "8.6", "8.9", "9.0", "10.0", "12.0")
METADATA = """Metadata-Version: 2.1
Name: splatwizard-cuda{major}
Version: {version}
Summary: CUDA kernels of Splatwizard's packages, compiled for CUDA {major}
License: MIT
Requires-Python: >=3.10
"""
WHEEL = """Wheel-Version: 1.0
Generator: build_cuda_wheel
Root-Is-Purelib: false
Tag: py3-none-{platform}
"""


def offered(nvcc: str) -> list[str]:
    """Return the ARCHITECTURES that a compiler knows, the last one with PTX."""
    known = subprocess.run([nvcc, "--list-gpu-arch"], capture_output=True, text=True, check=True).stdout.split()
    found = [a for a in ARCHITECTURES if f"compute_{a.replace('.', '')}" in known]
    return [*found[:-1], f"{found[-1]}+PTX"]


def compression(nvcc: str) -> str:
    """Return the flags by which a compiler makes its smallest libraries; since CUDA 12.8 it has a mode for that."""
    told = subprocess.run([nvcc, "--help"], capture_output=True, text=True, check=True).stdout
    return "--compress-mode=size" if "--compress-mode" in told else "-Xfatbin -compress-all"


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


def write_wheel(libraries: list[Path], major: int, versions: dict[str, str], tag: str, out: Path) -> Path:
    """Write a wheel with libraries, and the facts beside them, that pins packages (name -> version); its path."""
    version = versions["splatwizard-native"]
    name, about = f"splatwizard_cuda{major}", f"splatwizard_cuda{major}-{version}.dist-info"
    pins = "".join(f"Requires-Dist: {package}=={pinned}\n" for package, pinned in sorted(versions.items()))
    content = {f"{name}/__init__.py": f'"""CUDA kernels for CUDA {major}; splatwizard_native finds them."""\n'.encode()}
    for library in libraries:
        for path in (library, library.with_suffix(".json")):
            content[f"{name}/prebuilt/{path.name}"] = path.read_bytes()
    content[f"{about}/METADATA"] = (METADATA.format(major=major, version=version) + pins).encode()
    content[f"{about}/WHEEL"] = WHEEL.format(platform=tag).encode()
    record = ""
    for path, data in content.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
        record += f"{path},sha256={digest},{len(data)}\n"
    content[f"{about}/RECORD"] = f"{record}{about}/RECORD,,\n".encode()
    wheel = out / f"{name}-{version}-py3-none-{tag}.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as into:
        for path, data in content.items():
            info = zipfile.ZipInfo(path, (2020, 1, 1, 0, 0, 0))
            info.external_attr = 0o644 << 16
            into.writestr(info, data, zipfile.ZIP_DEFLATED, 9)
    return wheel


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
    os.environ.setdefault("NVCC_APPEND_FLAGS", compression(nvcc))
    machine, found = platform.machine(), list(modules())
    versions = {package.name: version_of(package) for package, _ in found}
    with tempfile.TemporaryDirectory() as scratch:
        libraries = [build_wheels.placed(module, machine, Path(scratch) / "prebuilt") for _, module in found]
        for library in libraries:
            print(f"{library.name} {library.stat().st_size:,}", flush=True)
        out.mkdir(parents=True, exist_ok=True)
        wheel = write_wheel(libraries, version[0], versions, build_wheels.platform_of(libraries, machine), out)
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    print(f"{wheel.name} {wheel.stat().st_size:,} sha256 {digest}")


if __name__ == "__main__":
    main()
