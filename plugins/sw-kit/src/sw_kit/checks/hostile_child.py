"""`python -m sw_kit.checks.hostile_child FILE COUNT SECONDS`: decode damaged versions of a file; prints JSON."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import torch

from splatwizard_core.tooling import decoded_limit, load_plugins, open_model
from sw_kit.hostile_files import Mutator, Tally, attempt

NOISE = 8 << 20  # bytes of resident set that come and go with the allocator, whatever is decoded
SEED = 17
MOST_PROBLEMS = 5


def main(path: Path, count: int, seconds: float) -> None:
    """Decode `count` damaged files, always the same ones; fewer where they take more than `seconds` of CPU time."""
    plugins, cpu, good = load_plugins(), torch.device("cpu"), path.read_bytes()
    open_model(path, plugins, cpu)  # imports what is imported late
    mutator, tally = Mutator(SEED), Tally()
    with tempfile.TemporaryDirectory() as folder:
        hostile = Path(folder) / "hostile.swz"

        def decode() -> str:
            open_model(hostile, plugins, cpu)
            return "decoded"

        began = time.process_time()
        for i in range(count):
            if time.process_time() - began > seconds:
                break
            data, kind = mutator.file([good])
            hostile.write_bytes(data)
            limit = 4 * decoded_limit(len(data)) + NOISE
            attempt(decode, f"file {i} ({kind})", limit, tally, plugins_may_miss=kind.startswith("header"))
            if len(tally.problems) >= MOST_PROBLEMS:
                break
    refused = sum(n for outcome, n in tally.outcomes.items() if outcome != "decoded")
    shown = sum(tally.outcomes.values())
    print(json.dumps({"problems": tally.problems, "refused": refused, "shown": shown, "slowest_s": tally.slowest_s}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))
