"""The kernels are really vectorised: against the same source built with one lane."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from sw_rasterizers.native import MODULE

BENCHMARK = Path(__file__).parents[3] / "benchmarks" / "rasterize_cpu.py"


@pytest.mark.slow  # compares clocks, and compiles twice
def test_packs_are_three_times_as_fast_as_one_lane():
    if MODULE.available() is not None:
        pytest.skip(str(MODULE.available()))
    cpuinfo = Path("/proc/cpuinfo")
    if not cpuinfo.exists() or "avx2" not in cpuinfo.read_text():
        pytest.skip("the bar holds for AVX2 and better")
    if not BENCHMARK.exists():
        pytest.skip("the benchmark is part of the repository, not of the package")

    def seconds(*build: str) -> dict[str, float]:
        command = [sys.executable, str(BENCHMARK), "--worker", *build, "--n", "30000", "--size", "180x160"]
        printed = subprocess.run([*command, "--repeats", "10"], check=True, capture_output=True, text=True).stdout
        return json.loads(printed.splitlines()[-1])

    ours, scalar = seconds("packs"), seconds("scalar")
    assert scalar["blend"] > 3 * ours["blend"]
    assert scalar["blend_backward"] > 3 * ours["blend_backward"]
