"""Build the WebAssembly decoder of .swz files that sw-view ships, from the kernels of the CPU libraries.

    pip install ziglang==0.17.1
    python tools/build_decoder.py            # writes decoder.wasm, exact_tables.zlib, build.json
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
USED_KERNELS = ("octree.cpp", "leaf_octree.cpp", "network.cpp", "sessions.cpp")
WISP = Path("plugins/sw-wisp/src/sw_wisp")
ZIGLANG = "0.17.1"
MOST_MEMORY = 1 << 30
STACK = 1 << 19
FLAGS = (
    "-target", "wasm32-wasi", "-mexec-model=reactor", "-std=c++20", "-Os", "-msimd128", "-ffp-contract=off",
    "-fno-rtti", "-s", "-DSW_ARCH=arch_native", f"-Wl,--max-memory={MOST_MEMORY}", f"-Wl,-z,stack-size={STACK}",
    "-I", str(ALONE), "-isystem", str(SHARED), "-I", str(KERNELS), "-I", str(WISP),
)  # fmt: skip
INCLUDE = re.compile(r'^#include ["<]([\w./]+)[">]', re.MULTILINE)


def sources() -> list[Path]:
    """Return what is compiled, relative to the repository."""
    own = sorted(path.relative_to(ROOT) for path in (ROOT / FOLDER / "source").glob("*.cpp"))
    return [*own, *(KERNELS / name for name in USED_KERNELS), WISP / "exact_kernels" / "pyramid.cpp"]


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
            places = (path.parent / name, KERNELS / name, WISP / name, ALONE / name, SHARED / name)
            waiting += [place for place in places if (ROOT / place).is_file()][:1]
    return sorted(found)


def sources_hash() -> str:
    """SHA-256 over names and bytes of all files that the module is made of, and over the flags."""
    sha = hashlib.sha256(" ".join(FLAGS).encode())
    for path in with_headers(sources()):
        content = (ROOT / path).read_bytes()
        sha.update(f"\n{path.as_posix()} {len(content)}\n".encode())
        sha.update(content)
    return sha.hexdigest()


def build(target: Path) -> dict[str, Any]:
    """Compile into `target`; what `build.json` says of it. Raises CalledProcessError if the compiler fails."""
    command = ["-m", "ziglang", "c++", *FLAGS, *map(str, sources()), "-o"]
    subprocess.run([sys.executable, *command, str(target)], cwd=ROOT, check=True)
    module = target.read_bytes()
    return {
        "command": " ".join(["python", *command, "decoder.wasm"]),
        "ziglang": ZIGLANG,
        "sources": sources_hash(),
        "sha256": hashlib.sha256(module).hexdigest(),
        "bytes": len(module),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare with what is shipped, write nothing")
    checks = parser.parse_args().check
    module, facts = ROOT / FOLDER / "decoder.wasm", ROOT / FOLDER / "build.json"
    tables = ROOT / TABLES
    packed = ROOT / FOLDER / "exact_tables.zlib"
    if not packed.is_file() or zlib.decompress(packed.read_bytes()) != tables.read_bytes():
        packed.write_bytes(zlib.compress(tables.read_bytes(), 9))
    with tempfile.TemporaryDirectory() as folder:
        built = Path(folder) / "decoder.wasm"
        found = build(built)
        if checks:
            shipped = json.loads(facts.read_text())
            sys.exit(0 if shipped == found else f"a build here gives {found['sha256']}, shipped is {shipped['sha256']}")
        module.write_bytes(built.read_bytes())
    facts.write_text(json.dumps(found, indent=2) + "\n")
    print(f"{module.relative_to(ROOT)}: {found['bytes']:,} bytes, sha256 {found['sha256']}")


if __name__ == "__main__":
    main()
