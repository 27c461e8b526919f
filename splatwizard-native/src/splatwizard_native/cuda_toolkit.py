"""The CUDA toolkit: the compiler, whether it fits torch, and the GPUs that kernels are compiled for."""

from __future__ import annotations

import functools
import importlib.util
import os
import re
import shutil
import subprocess
from pathlib import Path

from splatwizard_native.errors import NativeBuildError

ARCHITECTURE = re.compile(r"(\d+)\.(\d)([af]?)(\+PTX)?")


def find_nvcc() -> str | None:
    """The CUDA compiler, from $CUDA_HOME, $CUDA_PATH, the PATH or /usr/local/cuda; None if there is none."""
    for home in (os.environ.get("CUDA_HOME"), os.environ.get("CUDA_PATH")):
        if home and (Path(home) / "bin" / "nvcc").is_file():
            return str(Path(home) / "bin" / "nvcc")
    default = Path("/usr/local/cuda/bin/nvcc")
    return shutil.which("nvcc") or (str(default) if default.is_file() else None)


@functools.cache
def nvcc_version(nvcc: str) -> tuple[int, int] | None:
    """(major, minor) of a CUDA compiler, None if it does not say."""
    try:
        result = subprocess.run([nvcc, "--version"], capture_output=True, text=True, check=False)
    except OSError:
        return None
    found = re.search(r"release (\d+)\.(\d+)", result.stdout)
    return None if found is None else (int(found[1]), int(found[2]))


def root_of(nvcc: str) -> Path:
    """The toolkit's folder; an nvcc on the PATH may be a script that stands elsewhere."""
    beside = Path(nvcc).resolve().parent.parent
    homes = [beside, Path("/usr/local/cuda")]
    return next((home for home in homes if (home / "include" / "cuda_runtime.h").is_file()), beside)


def distributed() -> list[Path]:
    """Folders of libraries of `splatwizard-cudaN`: for torch's CUDA, then for older ones, which a driver runs, too."""
    import torch

    newest = int((torch.version.cuda or "0").partition(".")[0])
    specs = [importlib.util.find_spec(f"splatwizard_cuda{major}") for major in range(newest, 11, -1)]
    return [Path(folder) / "prebuilt" for spec in specs for folder in (spec and spec.submodule_search_locations) or ()]


def toolkit_mismatch() -> str | None:
    """The reason why CUDA kernels for this torch cannot be compiled here, or None."""
    import torch

    wanted = torch.version.cuda
    if wanted is None:
        return "this torch is built without CUDA: install a CUDA build of torch"
    major = wanted.partition(".")[0]
    nvcc = find_nvcc()
    if nvcc is None:
        return (
            f"no CUDA compiler was found (looked for nvcc in $CUDA_HOME, $CUDA_PATH, the PATH and /usr/local/cuda): "
            f"install the CUDA {major} toolkit"
        )
    version = nvcc_version(nvcc)
    if version is None:
        return f"{nvcc} does not run: correct $CUDA_HOME"
    if version[0] != int(major):
        return (
            f"torch is built for CUDA {wanted}, {nvcc} is of CUDA {version[0]}.{version[1]}: install a toolkit of CUDA "
            f"{major} and point CUDA_HOME at it, or install torch for CUDA {version[0]}"
        )
    return None


def architectures() -> list[str]:
    """Compute capabilities to compile for: $TORCH_CUDA_ARCH_LIST, else those of the GPUs here, else 8.0 and 9.0."""
    asked = sorted(a for a in re.split(r"[ ;,]+", os.environ.get("TORCH_CUDA_ARCH_LIST", "")) if a)
    for a in asked:
        if not ARCHITECTURE.fullmatch(a):
            raise NativeBuildError(f"$TORCH_CUDA_ARCH_LIST names '{a}': give compute capabilities, as 8.0;9.0")
    return asked or [f"{major}.{minor}" for major, minor in gpus()] or ["8.0", "9.0"]


def runs_on(architecture: str, gpu: tuple[int, int]) -> bool:
    """Whether code runs there: of "8.0" on 8.0 and any later 8.x, of "9.0a" on 9.0 alone, of "8.0+PTX" on all later."""
    found = ARCHITECTURE.fullmatch(architecture)
    if found is None:
        return False
    own = int(found[1]), int(found[2])
    return gpu == own if found[3] else gpu >= own and (found[4] is not None or gpu[0] == own[0])


def gpus() -> list[tuple[int, int]]:
    """Compute capabilities of the GPUs that torch sees, each once, in order."""
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    return sorted({torch.cuda.get_device_capability(i) for i in range(count)})
