"""Encode and decode seconds of wisp for as many splats as asked, from a trained file whose splats are repeated.

    sw run --method wisp --out out                      # makes out/demo/wisp/r3/scene.swz
    python benchmarks/wisp_seconds.py out/demo/wisp/r3/scene.swz [--n 300000] [--threads 2] [--repeats 5]

Copies of the scene stand side by side in a larger cube, with noise of half a step on every number, and are coded with
the networks of the file. Decoding is timed from the file's bytes to the GaussianModel, each time in a fresh process:
importing and loading kernels are told beside it and not in it. The CPU seconds tell what other work on the same cores
has cost. Bar: 2 s for 300,000 splats on two cores; encoding 20 s.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from splatwizard_core.api import ContainerReader, ContainerWriter
from sw_codecs.bits.packing import ByteReader
from sw_wisp import file
from sw_wisp.cube import Cube
from sw_wisp.numbers import HIGHEST_LEVEL
from sw_wisp.octree_contexts import Shares

DECODE = """
import sys, time
start = time.perf_counter()
import torch
from splatwizard_core.api import ContainerReader
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.decode import open_model
from sw_codecs.exact_native import EXACT
from sw_wisp.fast.exact_native import EXACT as OWN
from sw_wisp import method
torch.set_num_threads(int(sys.argv[2]))
plugins, ready = load_plugins(), EXACT.try_load() and OWN.try_load()
began, cpu = time.perf_counter(), time.process_time()
model, _ = open_model(sys.argv[1], plugins, torch.device("cpu"))
print(began - start, time.perf_counter() - began, time.process_time() - cpu, len(model.means), int(ready))
"""


def enlarged(path: Path, n: int) -> file.Scene:
    """The scene of a file, repeated until it has n splats."""
    reader = ContainerReader.open(path)
    decoded = file.decode(reader)
    with reader.decoding("networks") as data:
        parts = ByteReader(data)
        Shares.unpack(parts)
        context = file.CONTEXTS[reader.static["context"]].unpack(parts)
    shift = 0
    while 8**shift * len(decoded) < 2 * n:
        shift += 1
    draws, values, state = np.random.default_rng(0), decoded.values().double().numpy(), decoded.state
    fits = np.flatnonzero(state.levels + shift <= HIGHEST_LEVEL)
    levels, cells, numbers = [], [], []
    for copy in range(-(-n // len(fits))):
        at = copy >> shift * np.arange(3) & (1 << shift) - 1
        levels.append(state.levels[fits] + shift)
        cells.append(state.cells.places[fits] + (at << state.levels[fits, None]))
        noise = draws.uniform(-0.25, 0.25, (len(fits), values.shape[1]))
        numbers.append(values[fits] + noise * decoded.base_steps)
    cube = Cube(decoded.cube.low, decoded.cube.edge * 2**shift)
    return file.Scene(
        cube, np.concatenate(levels)[:n], np.concatenate(cells)[:n], torch.from_numpy(np.concatenate(numbers)[:n]),
        decoded.appearance, sh_degree=decoded.sh_degree, base_steps=tuple(decoded.base_steps.tolist()), context=context,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="a .swz file of wisp")
    parser.add_argument("--n", type=int, default=300_000, help="splats (default: 300,000)")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads (default: 2)")
    parser.add_argument("--repeats", type=int, default=5, help="decodings (default: 5)")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    scene = enlarged(args.file, args.n)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "scene.swz")
        began, cpu = time.perf_counter(), time.process_time()
        writer = ContainerWriter("wisp", 1)
        file.encode(scene, writer)
        path.write_bytes(writer.to_bytes())
        seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
        bits = 8 * path.stat().st_size / args.n
        print(f"{args.n:,} splats, {path.stat().st_size:,} bytes, {bits:.1f} bits each, {args.threads} threads")
        print(f"encode {seconds:.2f} s ({cpu:.2f} s of CPU), decoded again to compare", flush=True)
        rows = []
        for _ in range(args.repeats):
            command = [sys.executable, "-c", DECODE, str(path), str(args.threads)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            rows.append([float(x) for x in done.stdout.split()])
            assert rows[-1][3] == args.n
        imports, decode, work, _, ready = (statistics.median(column) for column in zip(*rows, strict=True))
        print(f"decode {decode:.2f} s ({work:.2f} s of CPU), median of {args.repeats}; import {imports:.2f} s")
        print(f"by {'compiled kernels' if ready else 'plain operations'}")
        print("each: " + ", ".join(f"{row[1]:.2f}" for row in rows))


if __name__ == "__main__":
    main()
