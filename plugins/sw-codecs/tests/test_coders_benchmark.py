"""benchmarks/coders.py runs: every coder, model and position codec gives back what it got, or the script stops."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "coders.py"


@pytest.mark.slow
def test_the_benchmark_runs_small():
    found = subprocess.run(
        [sys.executable, str(SCRIPT), "--symbols", "3000", "--repeats", "1"],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert found.returncode == 0, found.stderr
    for name in ("range", "rans", "huffman", "mixture", "gaussian-exact", "columns", "octree", "float-delta"):
        assert f"\n{name}" in found.stdout
