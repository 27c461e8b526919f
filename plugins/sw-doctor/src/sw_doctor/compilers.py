"""Checks of the C++ and the CUDA compiler: each compiles a few lines."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from splatwizard_core.tooling import Check
from splatwizard_native import NativeBuildError, find_compiler, find_nvcc, nvcc_version
from sw_doctor.text import one_line

GROUP = "compilers"
SECONDS = 120.0  # for a few lines; a busy machine takes 20

CXX_LINES = """\
#include <span>
#include <vector>
extern "C" int doctor(int n) {
    std::vector<int> v(n, 1);
    int sum = 0;
#pragma omp parallel for reduction(+ : sum)
    for (int i = 0; i < n; ++i) sum += std::span<int>(v)[i];
    return sum;
}
"""
CUDA_LINES = "__global__ void doctor(float *x) { x[threadIdx.x] += 1.0f; }\n"


def check_cxx() -> Check:
    """Compile and link a shared library of a few lines, with the flags that kernels need."""
    try:
        command = find_compiler()
    except NativeBuildError as error:
        if os.environ.get("CXX", "").strip():
            return Check(GROUP, "C++", "broken", one_line(error), "unset CXX, or set it to a compiler")
        return Check(GROUP, "C++", "missing", "no g++, c++ or clang++ on the PATH", how_to_get_a_compiler())
    flags = ["-std=c++20", "-O1", "-fPIC", "-shared", *(["-fopenmp"] if sys.platform != "darwin" else [])]
    problem = _compile(command, flags, CXX_LINES, "doctor.cpp")
    if problem is None:
        return Check(GROUP, "C++", "ok", _version(command))
    mend = how_to_get_a_compiler()
    if "omp" in problem:
        mend = "sudo apt install libomp-dev  (or use g++: export CXX=g++)"
    elif os.environ.get("CXX", "").strip():
        mend = "unset CXX, or set it to a compiler"
    return Check(GROUP, "C++", "broken", f"{' '.join(command)} does not compile C++20: {problem}", mend)


def check_nvcc() -> Check:
    """Compile a kernel of one line, unless the installed torch is a CPU build by its version.

    Whether the release fits torch is for `judge_nvcc` to say.
    """
    nvcc = find_nvcc()
    if nvcc is None:
        return Check(GROUP, "nvcc", "missing", "no CUDA compiler on the PATH, in $CUDA_HOME or in /usr/local/cuda")
    version = nvcc_version(nvcc)
    release = None if version is None else f"{version[0]}.{version[1]}"
    facts = {"path": nvcc, "release": release}
    problem = None if _torch_is_cpu_build() else _compile([nvcc], ["-c"], CUDA_LINES, "doctor.cu")
    if problem is not None:
        mend = "install the CUDA toolkit again, with a host compiler that it knows"
        try:
            find_compiler()
        except NativeBuildError:  # nvcc calls one, and says nothing of it
            mend = how_to_get_a_compiler()
        return Check(GROUP, "nvcc", "broken", f"{nvcc} does not compile a kernel: {problem}", mend, facts=facts)
    return Check(GROUP, "nvcc", "ok", f"CUDA {release or '(no release told)'}, {nvcc}", facts=facts)


def judge_nvcc(nvcc: Check, torch_cuda: str | None) -> Check:
    """Judge the finding about nvcc, knowing for which CUDA torch is built (None: for none).

    Kernels and torch must be of one major release: the runtime libraries of two do not mix in a process.
    """
    if torch_cuda is None:
        if nvcc.state == "ok":
            unused = f"{nvcc.detail} (not tried, and of no use: this torch has no CUDA)"
            return Check(GROUP, "nvcc", "ok", unused, facts=nvcc.facts)
        return Check(GROUP, "nvcc", "missing", "not needed: this torch has no CUDA", facts=nvcc.facts)
    wanted = f"install the CUDA toolkit {torch_cuda}: sudo apt install cuda-toolkit-{torch_cuda.replace('.', '-')}"
    if nvcc.state == "missing":
        return Check(GROUP, "nvcc", "missing", f"{nvcc.detail}; CUDA kernels cannot be compiled", wanted)
    release = nvcc.facts.get("release")
    if nvcc.state == "ok" and release is not None and release.split(".")[0] != torch_cuda.split(".")[0]:
        detail = f"CUDA {release} at {nvcc.facts['path']}, but torch is built for CUDA {torch_cuda}"
        return Check(GROUP, "nvcc", "broken", detail, wanted, facts=nvcc.facts)
    return nvcc


def _torch_is_cpu_build() -> bool:
    """By the version of the installed wheel, such as 2.13.0+cpu: torch itself is being imported meanwhile."""
    try:
        return importlib.metadata.version("torch").endswith("+cpu")
    except importlib.metadata.PackageNotFoundError:
        return True


def how_to_get_a_compiler() -> str:
    """Line that installs a compiler on this system."""
    if sys.platform == "darwin":
        return "xcode-select --install"
    if shutil.which("apt-get") is not None:
        return "sudo apt install g++"
    if shutil.which("dnf") is not None:
        return "sudo dnf install gcc-c++"
    return f"install g++ or clang++ with the package manager of {platform.system()}"


def _compile(command: list[str], flags: list[str], lines: str, name: str) -> str | None:
    """Compile these lines; return in one line why they do not compile, or None."""
    with tempfile.TemporaryDirectory(prefix="sw-doctor-") as folder:
        source, output = Path(folder) / name, Path(folder) / "out"
        source.write_text(lines)
        try:
            done = subprocess.run(
                [*command, *flags, str(source), "-o", str(output)],
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                timeout=SECONDS, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return f"gave no answer within {SECONDS:g} s"
        except OSError as error:
            return one_line(error.strerror or error)
        if done.returncode == 0 and output.is_file():
            return None
        told = done.stdout.decode("utf-8", errors="replace").strip().splitlines()
    errors = [line for line in told if re.search(r"\b(error|fatal|cannot|undefined)\b", line)]
    return one_line((errors or told or [f"status {done.returncode}"])[0]).replace(f"{folder}/", "")


def _version(command: list[str]) -> str:
    done = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=SECONDS, check=False)
    return one_line(done.stdout.partition("\n")[0] or " ".join(command))
