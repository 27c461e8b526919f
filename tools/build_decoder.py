"""Build the WebAssembly decoder of .swz files that sw-view ships, from the kernels of the CPU libraries.

    pip install ziglang==0.17.1
    python tools/build_decoder.py            # writes the modules, exact_tables.zlib, build.json
    python tools/build_decoder.py --check    # exits with 1 if a build here gives other bytes

`build.json` holds the command, the version of the compiler, and SHA-256 of the sources and of the module, so that a
test without a compiler can tell whether the shipped module is that of the sources. A build takes ten seconds, the first
one a minute.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOLDER = Path("plugins/sw-view/src/sw_view/splatwizard-decoder")
KERNELS = Path("plugins/sw-codecs/src/sw_codecs/exact_kernels")
ALONE = FOLDER / "source" / "alone"
SHARED = Path("splatwizard-native/src/splatwizard_native/include")
TABLES = Path("plugins/sw-codecs/src/sw_codecs/data/exact_tables.bin")
WISP = Path("plugins/sw-wisp/src/sw_wisp")
ANCHORS = Path("plugins/sw-anchors/src")
ZIGLANG = "0.17.1"
MOST_MEMORY = 1 << 30
STACK = 1 << 20
INCLUDES = (KERNELS, WISP, ALONE, FOLDER / "source", ANCHORS, SHARED)
FLAGS = (
    "-target", "wasm32-wasi", "-mexec-model=reactor", "-std=c++20", "-Os", "-msimd128", "-ffp-contract=off",
    "-fno-rtti", "-s", "-DSW_ARCH=arch_native", f"-Wl,--max-memory={MOST_MEMORY}", f"-Wl,-z,stack-size={STACK}",
    "-I", str(ALONE), "-isystem", str(SHARED), "-I", str(KERNELS), "-I", str(WISP), "-I", str(FOLDER / "source"),
    "-I", str(ANCHORS),
)  # fmt: skip
INCLUDE = re.compile(r'^#include ["<]([\w./]+)[">]', re.MULTILINE)
OF_ALL = (
    "base.cpp", "sha256.cpp", "json.cpp", "decimal.cpp", "container.cpp", "model.cpp", "decode.cpp", "exact_tables.cpp",
    "inflate.cpp", "arrays.cpp", "zstd.cpp", "symbols.cpp", "columns.cpp", "points.cpp",
)  # fmt: skip
"""Files of source/ that every module has; what none of its methods calls is left out of it."""
KERNELS_OF_ALL = ("octree.cpp", "network.cpp", "sessions.cpp")
KERNELS_OF_ANCHORS = (
    "bits.cpp", "streams.cpp", "lattice.cpp", "lookups.cpp", "mixtures.cpp", "mixture_rows.cpp", "planes.cpp",
)  # fmt: skip
MODULES = ("decoder.wasm", "codebooks.wasm", "anchors.wasm")
"""Modules that are built: explicit Gaussians and wisp; those that share colours or shapes; anchor methods."""


def sources(module: str) -> list[Path]:
    """Return what a module is compiled from, relative to the repository."""
    kernels = [KERNELS / name for name in KERNELS_OF_ALL]
    shared = [FOLDER / "source" / name for name in OF_ALL]
    if module == "codebooks.wasm":
        return [*shared, *_sources_in("source/codebooks"), *kernels]
    if module == "anchors.wasm":
        kernels += [*(KERNELS / name for name in KERNELS_OF_ANCHORS), ANCHORS / "sw_anchors" / "kernels" / "heads.cpp"]
        return [*shared, *_sources_in("source/anchors"), *kernels]
    return [*_sources_in("source"), *kernels, KERNELS / "leaf_octree.cpp", WISP / "exact_kernels" / "pyramid.cpp"]


def _sources_in(folder: str) -> list[Path]:
    return sorted(path.relative_to(ROOT) for path in (ROOT / FOLDER / folder).glob("*.cpp"))


def with_headers(paths: list[Path]) -> list[Path]:
    """Return the files and whatever of the repository they include."""
    found: dict[Path, None] = {}
    waiting = list(paths)
    while waiting:
        path = waiting.pop()
        if path in found:
            continue
        found[path] = None
        for name in INCLUDE.findall((ROOT / path).read_text(encoding="utf-8")):
            places = (path.parent, *INCLUDES)
            waiting += [place / name for place in places if (ROOT / place / name).is_file()][:1]
    return sorted(found)


def sources_hash(module: str) -> str:
    """SHA-256 over names and bytes of all files that a module is made of, and over the flags."""
    sha = hashlib.sha256(" ".join(FLAGS).encode())
    for path in with_headers(sources(module)):
        content = (ROOT / path).read_bytes()
        sha.update(f"\n{path.as_posix()} {len(content)}\n".encode())
        sha.update(content)
    return sha.hexdigest()


def build(module: str, target: Path) -> dict[str, Any]:
    """Compile into `target`; what `build.json` says of it. Raises CalledProcessError if the compiler fails."""
    command = ["-m", "ziglang", "c++", *FLAGS, *map(str, sources(module)), "-o"]
    subprocess.run([sys.executable, *command, str(target)], cwd=ROOT, check=True)
    content = target.read_bytes()
    return {
        "command": " ".join(["python", *command, module]),
        "ziglang": ZIGLANG,
        "sources": sources_hash(module),
        "sha256": hashlib.sha256(content).hexdigest(),
        "bytes": len(content),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare with what is shipped, write nothing")
    checks = parser.parse_args().check
    facts = ROOT / FOLDER / "build.json"
    tables = ROOT / TABLES
    packed = ROOT / FOLDER / "exact_tables.zlib"
    if not packed.is_file() or zlib.decompress(packed.read_bytes()) != tables.read_bytes():
        packed.write_bytes(zlib.compress(tables.read_bytes(), 9))
    with tempfile.TemporaryDirectory() as folder:
        found = {module: build(module, Path(folder) / module) for module in MODULES}
        if checks:
            shipped = json.loads(facts.read_text())
            sys.exit(0 if shipped == found else f"a build here gives {_hashes(found)}, shipped is {_hashes(shipped)}")
        for module in MODULES:
            (ROOT / FOLDER / module).write_bytes((Path(folder) / module).read_bytes())
    facts.write_text(json.dumps(found, indent=2) + "\n")
    for module, each in found.items():
        print(f"{FOLDER / module}: {each['bytes']:,} bytes, sha256 {each['sha256']}")


def _hashes(found: dict[str, Any]) -> str:
    return ", ".join(f"{module} {each['sha256']}" for module, each in found.items())


if __name__ == "__main__":
    main()
