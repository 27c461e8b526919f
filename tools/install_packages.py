"""Install packages of this workspace into an environment as `pip install --no-build-isolation -e` does.

    tools/install_packages.py --environment .venv --constraint constraints.txt splatwizard-core plugins/sw-3dgs ...

pip starts Python three times for each of them; here one process makes the editable wheels, and pip unpacks them and
brings what they depend on. Nothing is compiled ahead: Python writes the bytecode of a module when it is first imported.
A run imports an eighth of what torch, sympy and scipy bring: 2 s of CPU instead of 36. The environment is made if it is
not there; without --environment it is the running one, which has hatchling and editables.

    --kernels sw_rasterizers.native:MODULE ...

are compiled meanwhile, from the first moment on: that takes the sources alone. One that cannot be built is told by
what uses it first.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

BUILD_TOOLS = ("hatchling", "editables", "filelock")
PIP = ("-m", "pip", "--disable-pip-version-check", "install", "-q")

BUILD = """
import contextlib, fcntl, os, pkgutil, sys, types

class FileLock:
    # In place of filelock, which is not there yet, and locks files in the same way.
    def __init__(self, path, **settings):
        self.file = open(path, "a")

    @contextlib.contextmanager
    def acquire(self, timeout):
        with self.file:
            fcntl.flock(self.file, fcntl.LOCK_EX)
            yield

os.nice(3)  # pip has one core at most, and should have it
sys.modules["filelock"] = types.SimpleNamespace(FileLock=FileLock, Timeout=TimeoutError)
for target in sys.argv[1:]:
    pkgutil.resolve_name(target).build(say=lambda line: None)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--environment", type=Path, help="folder of a virtual environment, made if it is not there")
    parser.add_argument("--constraint", required=True, type=Path)
    parser.add_argument("--kernels", default="", help="MODULE:NAME of native modules, separated by commas")
    parser.add_argument("folders", nargs="+", type=Path)
    given = parser.parse_args()
    constraint, folders = str(given.constraint.resolve()), [folder.resolve() for folder in given.folders]
    with building(list(filter(None, given.kernels.split(","))), folders):
        if given.environment is None:
            install(constraint, folders)
        else:
            python = environment(given.environment)
            # hatchling first: with it at hand no package needs a build environment of its own.
            subprocess.run([python, *PIP, "-c", constraint, *BUILD_TOOLS], check=True)
            subprocess.run([python, __file__, "--constraint", constraint, *map(str, folders)], check=True)


def environment(folder: Path) -> str:
    """Return the Python of a virtual environment, made if it is not there."""
    python = folder / "bin" / "python"
    if not (python.exists() and python.with_name("pip").exists()):  # pip comes last, unless that was interrupted
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    return str(python)


def install(constraint: str, folders: Sequence[Path]) -> None:
    """Install the packages, editable, and what they depend on into the running environment."""
    pip = [sys.executable, *PIP, "--no-compile", "-c", constraint]
    with tempfile.TemporaryDirectory() as made:
        wheels = [Path(made) / editable_wheel(folder, made) for folder in folders]
        subprocess.run([*pip, "--no-deps", "--force-reinstall", *map(str, wheels)], check=True)
    names = [wheel.name.partition("-")[0] for wheel in wheels]
    for name, folder in zip(names, folders, strict=True):
        note_origin(name, folder)
    subprocess.run([*pip, *names], check=True)


@contextlib.contextmanager
def building(kernels: Sequence[str], folders: Sequence[Path]) -> Iterator[None]:
    """Compile kernels of the packages during the block, on all cores; wait for them at its end."""
    if not kernels:
        yield
        return
    command = [sys.executable, "-S", "-c", BUILD, *kernels]  # nothing that is installed here is needed
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(folder / "src") for folder in folders)}
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL):
        yield


def editable_wheel(folder: Path, made: str) -> str:
    from hatchling.build import build_editable

    os.chdir(folder)
    return build_editable(made)


def note_origin(name: str, folder: Path) -> None:
    """Note that a distribution is the folder itself, which `pip list`, `pip uninstall` and our advice tell."""
    (noted,) = (file for file in importlib.metadata.files(name) or () if file.name == "direct_url.json")
    origin = {"dir_info": {"editable": True}, "url": folder.as_uri()}
    Path(str(noted.locate())).write_text(json.dumps(origin), encoding="utf-8")


if __name__ == "__main__":
    main()
