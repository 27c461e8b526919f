"""Install packages of this workspace into the running environment as `pip install --no-build-isolation -e` does.

    tools/install_packages.py --constraint constraints.txt splatwizard-core plugins/sw-3dgs ...

pip starts Python three times for each of them; here one process makes the editable wheels, and pip unpacks them and
brings what they depend on. Nothing is compiled ahead: Python writes the bytecode of a module when it is first imported.
A run imports an eighth of what torch, sympy and scipy bring: 2 s of CPU instead of 36. Needs hatchling and editables.

    --kernels sw_rasterizers.native:MODULE ...

are compiled while pip brings what the packages depend on, which keeps one core busy; building them takes none of it but
filelock. One that cannot be built is told by what uses it first.
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

from hatchling.build import build_editable

BUILD = """
import pkgutil, sys

for target in sys.argv[1:]:
    pkgutil.resolve_name(target).build(say=lambda line: None)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--constraint", required=True, type=Path)
    parser.add_argument("--kernels", default="", help="MODULE:NAME of native modules, separated by commas")
    parser.add_argument("folders", nargs="+", type=Path)
    given = parser.parse_args()
    constraint, folders = str(given.constraint.resolve()), [folder.resolve() for folder in given.folders]
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "-q", "--no-compile"]
    pip += ["-c", constraint]
    with tempfile.TemporaryDirectory() as made:
        wheels = [Path(made) / editable_wheel(folder, made) for folder in folders]
        subprocess.run([*pip, "--no-deps", "--force-reinstall", *map(str, wheels)], check=True)
    names = [wheel.name.partition("-")[0] for wheel in wheels]
    for name, folder in zip(names, folders, strict=True):
        note_origin(name, folder)
    with building(list(filter(None, given.kernels.split(",")))):
        subprocess.run([*pip, *names], check=True)


@contextlib.contextmanager
def building(kernels: Sequence[str]) -> Iterator[None]:
    """Compile kernels during the block, on all cores but the one that it keeps busy; wait for them at its end."""
    command = [sys.executable, "-c", BUILD, *kernels]
    environment = {"MAX_JOBS": str(max(1, (os.cpu_count() or 1) - 1)), **os.environ}
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL):
        yield


def editable_wheel(folder: Path, made: str) -> str:
    os.chdir(folder)
    return build_editable(made)


def note_origin(name: str, folder: Path) -> None:
    """Note that a distribution is the folder itself, which `pip list`, `pip uninstall` and our advice tell."""
    (noted,) = (file for file in importlib.metadata.files(name) or () if file.name == "direct_url.json")
    origin = {"dir_info": {"editable": True}, "url": folder.as_uri()}
    Path(str(noted.locate())).write_text(json.dumps(origin), encoding="utf-8")


if __name__ == "__main__":
    main()
