"""Drives the compilers: finds them, knows the flags, compiles in parallel, and makes their errors readable.

Not torch.utils.cpp_extension: that gives one set of flags to all files of a module, needs ninja and setuptools,
and waits for ever on the lock of a dead process.
"""

from __future__ import annotations

import contextlib
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from splatwizard_native import cuda_toolkit
from splatwizard_native.cores import available_cores
from splatwizard_native.errors import CompilerMissingError, NativeBuildError

SHARED_INCLUDE = Path(__file__).parent / "include"
SHARED_INCLUDE_FLAGS = ("-isystem", str(SHARED_INCLUDE))
SHOWN_LINES = 10
COMPILERS = ("g++", "c++", "clang++")
COMMON_FLAGS = ("-std=c++20", "-O3", "-fPIC", "-fvisibility=hidden", "-fopenmp-simd", "-pthread")

# namespace of the kernels -> flags, for a binary that runs on any x86-64 of the last fifteen years
X86_LEVELS = {
    "arch_v2": ("-march=x86-64-v2",),
    "arch_v3": ("-march=x86-64-v3",),
    # 512: GCC otherwise keeps to 256-bit vectors on AVX-512 machines, half the speed on current server cores.
    "arch_v4": ("-march=x86-64-v4", "-mprefer-vector-width=512"),
}


@dataclass(frozen=True)
class Job:
    """One file to compile: command line without compiler, where the object goes."""

    source: Path
    output: Path
    flags: tuple[str, ...]
    cuda: bool = False


def find_compiler() -> list[str]:
    """The C++ compiler's command: $CXX, else the first of g++, c++, clang++. Raises CompilerMissingError."""
    chosen = os.environ.get("CXX", "").strip()
    if chosen:
        try:
            command = shlex.split(chosen)
        except ValueError as error:
            raise CompilerMissingError(f"$CXX is '{chosen}', which is no command ({error}): correct it") from error
        if shutil.which(command[0]) is None:
            raise CompilerMissingError(f"$CXX is '{chosen}', which is not there: unset CXX or correct it")
        return command
    for name in COMPILERS:
        if shutil.which(name) is not None:
            return [name]
    raise CompilerMissingError(
        "no C++ compiler was found (looked for g++, c++ and clang++): install one, on Debian or Ubuntu with "
        "`sudo apt install g++`"
    )


def cpu_identity() -> str:
    """The CPU's feature list and model, on which -march=native depends."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return platform.processor() or platform.machine()
    told = dict(re.findall(r"^(.*?)\s*:(.*)$", text.partition("\n\n")[0], re.MULTILINE))
    # Model too: the compiler tunes for it.
    wanted = ("CPU part", "Features", "flags", "model name")
    return repr([(key, " ".join(sorted(told[key].split()))) for key in wanted if key in told])


def cuda_flags(flag: str, folder: str) -> tuple[str, ...]:
    """Return a flag and the folder of the CUDA toolkit that it is for."""
    return flag, str(cuda_toolkit.root_of(cuda_toolkit.find_nvcc() or "nvcc") / folder)


def arch_variants(march: str) -> dict[str, tuple[str, ...]]:
    """Kernel namespace -> flags. march: "native" (this machine), "portable" (any of its kind), "x86_64", "aarch64"."""
    machine = "x86_64" if platform.machine() == "AMD64" else platform.machine()
    if march == "native":
        return {"arch_native": ("-march=native", *(("-mprefer-vector-width=512",) if machine == "x86_64" else ()))}
    if march == "portable" or march in ("x86_64", "aarch64"):
        return dict(X86_LEVELS) if (machine if march == "portable" else march) == "x86_64" else {"arch_native": ()}
    raise ValueError(f"march is '{march}'; it must be 'native', 'portable', 'x86_64' or 'aarch64'")


class Toolchain:
    """Runs compilers, at most `jobs` at a time over all modules that share this object.

    jobs    None: $MAX_JOBS, else the cores that this process may use
    """

    def __init__(self, jobs: int | None = None) -> None:
        limit = os.environ.get("MAX_JOBS", "")
        self._compilers = Compilers()
        self._pool = ThreadPoolExecutor(jobs or (int(limit) if limit.isdigit() else 0) or available_cores())
        self.compiler = find_compiler()

    def version(self) -> str:
        """First line of what the compiler says of itself."""
        result = subprocess.run([*self.compiler, "--version"], capture_output=True, text=True, check=False)
        return result.stdout.partition("\n")[0]

    def compile(self, jobs: Sequence[Job], log: Path) -> None:
        """Compile all files. Raises NativeBuildError with the first compiler error; everything goes to `log`."""
        runs = []
        for job in jobs:
            compiler = [str(cuda_toolkit.find_nvcc())] if job.cuda else self.compiler
            written = ["-MD", "-MF", f"{job.output}.d", "-c", str(job.source), "-o", str(job.output)]
            runs.append(self._pool.submit(self._compilers.run, [*compiler, *job.flags, *written], log))
        try:
            for run in runs:  # to the end of all; `wait` is told of none that was called off before it began
                run.exception()
        except BaseException:  # asked to end: nobody waits for what compilers do meanwhile
            self.stop()
            raise
        for run in runs:
            run.result()

    def link(self, objects: Iterable[Path], output: Path, log: Path, libraries: Sequence[str]) -> None:
        """Link a shared library."""
        command = [*self.compiler, "-shared", *map(str, objects), "-o", str(output), *libraries]
        try:
            self._pool.submit(self._compilers.run, command, log).result()
        except NativeBuildError:
            raise
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """End the compilers that run, with the processes that they started, and start no other."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._compilers.stop()


def libraries(march: str, shown: Path, *, cuda: bool = False) -> list[str]:
    """Return what links a library: a portable one brings its C++ runtime, and has a list of what it shows.

    One for GPUs brings CUDA's runtime, and hides it: it must not mix with that of torch, which may be another one.
    """
    runtime = [*cuda_flags("-L", "lib64"), "-lcudart_static", "-ldl", "-lrt"] if cuda else []
    shows = f"-Wl,--version-script={shown}"
    if march != "native" and sys.platform == "linux":
        return ["-pthread", *runtime, "-static-libstdc++", "-static-libgcc", shows, "-Wl,-s,-z,defs"]
    return [*runtime_libraries(), "-pthread", *runtime, *([shows] if cuda else [])]


def runtime_libraries() -> list[str]:
    """Paths of the C++ runtime (libstdc++, libgcc_s) that this process, and so torch, runs on; empty but on Linux.

    Linked before the compiler's own. One that brings static ones alone would put a second runtime into the module:
    numbers in its messages are lost, and an error that passes through it ends the process.
    """
    with contextlib.suppress(OSError):
        mapped = {line.split(maxsplit=5)[-1].strip() for line in Path("/proc/self/maps").read_text().splitlines()}
        named = (Path(path) for path in sorted(mapped) if path.startswith("/"))
        return [str(p) for p in named if p.name.startswith(("libgcc_s.so.1", "libstdc++.so.6")) and p.is_file()]
    return []


class Compilers:
    """Compilers that run, each the leader of a group of processes: `g++` only starts what does the work."""

    def __init__(self) -> None:
        self._lock, self._running, self._stopped = threading.Lock(), set[subprocess.Popen[bytes]](), False

    def run(self, command: list[str], log: Path) -> None:
        """Run one to its end, its output to `log`. Raises NativeBuildError if it fails."""
        with self._lock:
            if self._stopped:
                raise NativeBuildError("the build was stopped")
            process = subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=os.name == "posix"
            )
            self._running.add(process)
        text = process.communicate()[0].decode("utf-8", errors="replace")
        with self._lock:
            self._running.discard(process)
        with open(log, "a", encoding="utf-8") as handle:
            handle.write(f"$ {shlex.join(command)}\n{text}\n")
        if process.returncode < 0:
            raise NativeBuildError(
                f"the compiler was killed by signal {-process.returncode} (out of memory?): try again with MAX_JOBS=1"
            )
        if process.returncode != 0:
            raise NativeBuildError(_excerpt(text))

    def stop(self) -> None:
        """Kill all that run: what they wrote so far lies in a folder that is removed."""
        with self._lock:
            self._stopped = True
            for process in self._running:
                with contextlib.suppress(OSError):
                    if os.name == "posix":
                        os.killpg(process.pid, signal.SIGKILL)
                    else:
                        process.kill()


def _excerpt(text: str) -> str:
    """The part of the compiler's output that says what is wrong: from the first error on, or the last lines."""
    lines = text.rstrip().splitlines()
    first = next((i for i, line in enumerate(lines) if re.search(r"\b(error|fatal|undefined)\b", line)), None)
    shown = lines[first : first + SHOWN_LINES] if first is not None else lines[-SHOWN_LINES:]
    return "\n".join(f"  {line}" for line in shown)


def read_dependencies(path: Path) -> list[Path]:
    """The files that one compilation read, from the compiler's make rule."""
    rule = path.read_text(encoding="utf-8").replace("\\\n", " ")
    return [Path(p.replace("\\ ", " ")) for p in re.split(r"(?<!\\)\s+", rule.partition(": ")[2].strip()) if p]
