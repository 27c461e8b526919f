"""Symbols a second and core that the columns of a `.swz` are coded with.

    python benchmarks/columns_rate.py [--rows 1000000] [--columns 21] [--scale 3] [--threads 1 2 4]

Columns are of whole numbers, normal with a standard deviation of --scale. Each number of threads writes and reads one
matrix as `sw_codecs.entropy.columns` does: plans, tables, streams, checksums. CPU time is that of the process, so a
busy machine tells the same.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from sw_codecs.entropy.columns import Columns
from sw_codecs.fast import threads


def main() -> None:
    """Print a line for each number of threads."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--columns", type=int, default=21)
    parser.add_argument("--scale", type=float, default=3.0)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    given = parser.parse_args()
    random = np.random.default_rng(0)
    symbols = np.rint(random.normal(0, given.scale, (given.rows, given.columns))).astype(np.int16)
    print("threads | encode: s, M symbols/s, of CPU time | decode: s, M symbols/s, of CPU time | bits a symbol")
    for count in given.threads:
        threads.MOST = count
        told, data = [], b""
        for step in ("encode", "decode"):
            began, used = time.perf_counter(), time.process_time()
            if step == "encode":
                data = Columns().encode(symbols, None)
            else:
                assert np.array_equal(Columns().decode(data, symbols.shape), symbols)
            took, cpu = time.perf_counter() - began, time.process_time() - used
            told.append(f"{took:6.2f} {symbols.size / took / 1e6:6.1f} {symbols.size / cpu / 1e6:6.1f}")
        print(f"{count:7} | {told[0]:>35} | {told[1]:>35} | {8 * len(data) / symbols.size:.2f}", flush=True)


if __name__ == "__main__":
    main()
