"""benchmarks/anchor_files.py runs: files of both methods decode to one model in any number of threads."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "anchor_files.py"


@pytest.mark.slow
def test_the_benchmark_runs_small():
    found = subprocess.run(
        [sys.executable, str(SCRIPT), "--anchors", "600", "--repeats", "1", "--threads", "1,2"],
        capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    for part in (
        "hac, ",
        "cat-3dgs, ",
        "triplane",
        "context networks",
        "symbols",
        "encode 2 threads",
        "decode 2 threads",
    ):
        assert part in found.stdout
    assert found.stdout.count("digest of the model") == 2
