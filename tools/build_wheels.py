"""Build the wheels of all packages; those with C++ kernels hold them compiled, for any torch and any Python.

    python tools/build_wheels.py [--out dist] [--machine aarch64] [sw-codecs ...]

Needs hatchling, filelock and a C++ compiler ($CXX): no torch. A wheel with kernels is
`py3-none-manylinux_2_N_<machine>`, N the newest glibc that its libraries ask for. For an older N, or another kind of
machine, take zig (`pip install ziglang`), which brings its own C library:

    CXX="python -m ziglang c++ -target aarch64-linux-gnu.2.28" python tools/build_wheels.py --machine aarch64

Two builds by one compiler give the same bytes, wherever they run. `--libraries` compiles into the packages' sources
instead, for builders that make the wheel themselves (pyproject.toml, [tool.cibuildwheel]).
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatwizard_native import Toolchain

ROOT = Path(__file__).resolve().parents[1]
DECLARES = re.compile(r"^(\w+) = NativeModule\(", re.MULTILINE)
Module = Any
"""A `splatwizard_native.NativeModule`, which is imported once its folder is on the path."""
EPOCH = "1577836800"  # 2020-01-01: zip files know no time before 1980, and hatchling takes one


def packages(names: Sequence[str]) -> list[Path]:
    """Folders of the named packages, or of all."""
    found = sorted(path.parent for path in ROOT.glob("*/pyproject.toml") if path.parent.name.startswith("splatwizard"))
    found += sorted(path.parent for path in ROOT.glob("plugins/*/pyproject.toml"))
    unknown = set(names) - {folder.name for folder in found}
    if unknown:
        sys.exit(f"there is no package {', '.join(sorted(unknown))}")
    return [folder for folder in found if not names or folder.name in names]


def declared(package: Path) -> Iterator[Module]:
    """The native modules of a package, which has to be on the path."""
    from splatwizard_native import NativeModule

    for path in sorted((package / "src").rglob("*.py")):
        for name in DECLARES.findall(path.read_text(encoding="utf-8")):
            relative = path.relative_to(package / "src")
            module = getattr(importlib.import_module(".".join(relative.with_suffix("").parts)), name)
            if isinstance(module, NativeModule):
                yield module


def placed(module: Module, machine: str, folder: Path) -> Path:
    """Compile a module into a `prebuilt` folder, with the facts beside it that the loader looks for."""
    with tempfile.TemporaryDirectory() as scratch:
        tools = toolchain()
        built = module.build(march=machine, folder=Path(scratch), tools=tools)
        told = json.loads(built.with_suffix(".json").read_text(encoding="utf-8"))
        place = folder / module.prebuilt_name("portable")
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(built, place)
    facts = {"sha256": hashlib.sha256(place.read_bytes()).hexdigest(), "compiler": tools.version()}
    facts |= {"architectures": told["architectures"]} if told["architectures"] else {}
    place.with_suffix(".json").write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    return place


def compiled(package: Path, machine: str, into: Path) -> Iterator[Path]:
    """Compile the modules of a package for the CPU; put each into its place below `into`, a folder like src."""
    for module in declared(package):
        if not module.cuda_sources:
            yield placed(module, machine, into / Path(*module.package.split(".")) / "prebuilt")


def toolchain() -> Toolchain:
    """The compiler; zig takes the same flags but for names of CPUs, in which `-` switches a feature off."""
    from splatwizard_native import Toolchain, find_compiler

    class Zig(Toolchain):
        def version(self) -> str:  # compiled objects are found again by it, and the target is no other flag
            return f"{super().version()} {' '.join(self.compiler[1:])}"

        def compile(self, jobs: Sequence[Any], log: Path) -> None:
            named = re.compile("^-march=x86-64-v")
            super().compile(
                [replace(job, flags=tuple(named.sub("-march=x86_64_v", f) for f in job.flags)) for job in jobs], log
            )

    return Zig() if any("zig" in Path(part).name for part in find_compiler()) else Toolchain()


def platform_of(libraries: Sequence[Path], machine: str) -> str:
    """The tag of a wheel with these libraries."""
    versions = [int(v) for path in libraries for v in re.findall(rb"GLIBC_2\.(\d+)", path.read_bytes())]
    return f"manylinux_2_{max([17, *versions])}_{machine}" if sys.platform == "linux" else ""


def build(package: Path, machine: str, out: Path) -> Path:
    """Build the wheel of a package from a copy of its folder; its path."""
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / package.name
        shutil.copytree(package, copy, ignore=shutil.ignore_patterns("__pycache__", "prebuilt", "tests"))
        libraries = list(compiled(package, machine, copy / "src"))
        environment = {**os.environ, "SOURCE_DATE_EPOCH": os.environ.get("SOURCE_DATE_EPOCH", EPOCH)}
        if libraries:
            environment["SPLATWIZARD_WHEEL_PLATFORM"] = platform_of(libraries, machine)
        command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(Path(scratch) / "wheel")]
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            sys.exit(f"{package.name}: {done.stdout}{done.stderr}")
        (wheel,) = (Path(scratch) / "wheel").iterdir()
        return Path(shutil.copyfile(wheel, out / wheel.name))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packages", nargs="*", help="all, if none is named")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the wheels")
    parser.add_argument("--machine", choices=("x86_64", "aarch64"), default=platform.machine())
    parser.add_argument("--libraries", action="store_true", help="compile into the packages' sources, build no wheel")
    arguments = parser.parse_args()
    sys.path[:0] = [str(package / "src") for package in packages([])]
    for package in packages(arguments.packages):
        if arguments.libraries:
            for path in compiled(package, arguments.machine, package / "src"):
                print(path)
            continue
        arguments.out.mkdir(parents=True, exist_ok=True)
        wheel = build(package, arguments.machine, arguments.out)
        print(f"{wheel.name} {wheel.stat().st_size:,}", flush=True)


if __name__ == "__main__":
    main()
