"""SHA-256 of decoded files in Python, wasmtime, Node and Chromium, method by method.

    python benchmarks/decoder_hashes.py [--out build/decoder-hashes] [--steps 30] [--methods hac,wisp]

Files are those of tests/golden, and one of each rate point of each method that the decoder in WebAssembly knows:
trained on the scene `demo` (below --out; what is there is not done again), in few steps and on small pictures, since
files of poor scenes exercise a decoder as well as those of good ones. A cell is the beginning of SHA-256 over the
hashes of all files of its row: equal cells mean that each file has the same hash. Exits with 1 where one differs or is
refused, and names it.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import sys
import tempfile
from pathlib import Path

from sw_view.coded_file import FIELD, METHODS, OF_ANCHORS, covers

from splatwizard_core.api import ContainerReader
from splatwizard_core.cli.main import main as sw
from splatwizard_core.tooling import load_plugins

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from decoder_engines import GOLDEN, Told, Wasmtime, in_chromium, in_node, in_python

ENGINES = ("Python", "wasmtime", "Node", "Chromium")
KNOWN = (*METHODS, "chimerags", FIELD, "wisp", *OF_ANCHORS)
DIGITS = 10


def train_and_encode(method: str, steps: int, out: Path) -> None:
    """A file of every rate point on demo. In this process: starting one for each takes longer than the rest."""
    values = [f"iterations={steps}", "scale_schedule=true", "resolution=4"]
    options = [option for value in values for option in ("--set", value)]
    for rate in load_plugins().methods.load(method).RATES:
        target = out / "demo" / method / rate / "scene.swz"
        if target.is_file():
            continue
        train = ["train", "--method", method, "--rate", rate, "--scene", "demo", *options, "--out", str(out)]
        for command in (train, ["encode", str(target.parent), "--no-psnr"]):
            with contextlib.redirect_stdout(io.StringIO()):
                status = sw(command)
            if status:
                sys.exit(f"`sw {' '.join(command)}` ended with {status}")


def told(paths: list[Path]) -> list[list[Told]]:
    """Hashes or reasons of each engine, file by file."""
    contents, wasmtime = [path.read_bytes() for path in paths], Wasmtime()
    with tempfile.TemporaryDirectory() as folder:
        return [
            [in_python(data) for data in contents], [wasmtime.told(data) for data in contents], in_node(paths),
            in_chromium(paths, Path(folder)),
        ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/decoder-hashes"))
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--methods", default=",".join(KNOWN))
    given = parser.parse_args()
    methods = given.methods.split(",")
    for method in methods:
        train_and_encode(method, given.steps, given.out)
    found = sorted(GOLDEN.glob("*.swz")) + sorted((given.out / "demo").glob("*/*/scene.swz"))
    readers = {path: ContainerReader.open(path) for path in found}
    print("| method | golden | demo | " + " | ".join(ENGINES) + " |")
    print("|" + "---|" * (3 + len(ENGINES)))
    wrong = [f"{path}: this decoder does not know it" for path, reader in readers.items() if not covers(reader)]
    for method in methods:
        paths = [path for path, reader in readers.items() if reader.method == method and covers(reader)]
        engines = told(paths)
        cells = [hashlib.sha256(repr([sha for sha, _ in each]).encode()).hexdigest()[:DIGITS] for each in engines]
        golden = sum(path.parent == GOLDEN for path in paths)
        print(f"| `{method}` | {golden} | {len(paths) - golden} | {' | '.join(cells)} |", flush=True)
        for path, *row in zip(paths, *engines, strict=True):
            if row[0][0] is None or len(set(row)) > 1:
                wrong.append(f"{path}: {dict(zip(ENGINES, row, strict=True))}")
    sys.exit("\n".join(wrong) or None)


if __name__ == "__main__":
    main()
