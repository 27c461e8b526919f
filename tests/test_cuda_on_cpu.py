"""Kernels of CUDA compute on a CPU what torch operations do (cuda_on_cpu.py), so that no change waits for a GPU."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from cuda_on_cpu import FLAGS, HEADERS, ON_DEVICE, as_cpp

ROOT = Path(__file__).parents[1]
RUNS = {
    "hac": (
        "sw-hac/tests/test_mixed_grid.py", "sw-hac/tests/fast", "sw-hac-plus/tests/fast",
        "not neither_values or hac_plus",
    ),
    "codecs": ("sw-codecs/tests/context/test_grid_lookup.py", "sw-codecs/tests/test_codecs_cuda.py", ""),
    "planes": (
        "sw-cat-3dgs/tests/fast/test_plane_kernels.py", "sw-cat-3dgs/tests/fast/test_same_as_plain.py",
        "sw-cat-3dgs/tests/test_triplane.py", "not 72 and not sizes0 and not sizes1 and not (each_time and sizes3)",
    ),
    "anchors": (
        "sw-anchors/tests/fast/test_row_kernels.py", "sw-anchors/tests/fast/test_network_kernel.py",
        "not 20000 and not 8449 and not each_time",
    ),
    "training": ("../splatwizard-core/tests/training/test_training_cuda.py", ""),
}  # fmt: skip
"""Folders and files of tests below plugins/, then the small ones of their tests."""
LEAST = {"hac": 60, "codecs": 22, "planes": 20, "anchors": 12, "training": 12}
"""How many of them there are, at least."""

pytestmark = pytest.mark.slow


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    env = {name: value for name, value in os.environ.items() if name not in ("TEST_JOBS", "TEST_WORKER")}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "cuda_on_cpu", "-m", "cuda", "-p", "no:cacheprovider"]
    env["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT / "tests"), env.get("PYTHONPATH")]))
    return subprocess.run([*command, *arguments], cwd=ROOT, env=env, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", RUNS)
def test_kernels_compute_what_torch_does(name):
    *files, chosen = RUNS[name]
    done = run(*(ROOT / "plugins" / file for file in files), "-k", chosen)
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]
    assert int(re.findall(r"(\d+) passed", done.stdout)[-1]) >= LEAST[name]


KERNEL = """
__global__ void shift_kernel(const float* from, float* to, int apart) {
  __shared__ float room[64];
  room[threadIdx.x] = from[threadIdx.x];
  BARRIER
  to[threadIdx.x] = room[(threadIdx.x + apart) % 64] + __shfl_xor_sync(0xffffffffu, float(threadIdx.x), 1);
}
extern "C" int shift(const float* from, float* to, int apart, unsigned blocks, unsigned threads) {
  shift_kernel<<<blocks, threads, 0, cudaStream_t(1)>>>(from, to, apart);
  return cudaGetLastError();
}
"""
SHIFT = """
import ctypes, sys
import numpy
library = ctypes.CDLL(sys.argv[1])
x, to = numpy.arange(64, dtype=numpy.float32), numpy.zeros(64, numpy.float32)
call = lambda *sizes: library.shift(ctypes.c_void_p(x.ctypes.data), ctypes.c_void_p(to.ctypes.data), 40, *sizes)
assert call(0, 64) == 9 and call(1, 1025) == 9
assert call(1, 64) == 0
sys.exit(int((to != (x + 40) % 64 + (x.astype(int) ^ 1)).any()))
"""


@pytest.mark.parametrize(("barrier", "status"), [("__syncthreads();", 0), ("", 1)])
def test_threads_wait_for_one_another_only_where_they_say_so(tmp_path, barrier, status):
    source, library = tmp_path / "shift.cpp", tmp_path / "shift.so"
    source.write_text(as_cpp(KERNEL.replace("BARRIER", barrier)))
    flags = [*FLAGS, "-fvisibility=default", f"-I{HEADERS}", *ON_DEVICE]
    subprocess.run(["g++", *flags, "-shared", str(source), "-o", str(library)], check=True)
    assert subprocess.run([sys.executable, "-c", SHIFT, str(library)], check=False).returncode == status
