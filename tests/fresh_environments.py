"""Fresh environments for tests that need really installed distributions, without a network.

A fresh environment has its own interpreter prefix and site-packages; third-party packages are linked in from
the running environment, ours are not: they come from wheels built here.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from strangers_site import EACH, Done

ROOT = Path(__file__).resolve().parents[1]
WORKSPACE = [
    ROOT / "splatwizard-native", ROOT / "splatwizard-core",
    *sorted(p.parent for p in (ROOT / "plugins").glob("*/pyproject.toml")),
]  # fmt: skip
OURS = ("splatwizard", "sw_", "sw-")


def is_ours(name: str) -> bool:
    """Whether a file in site-packages belongs to a workspace package (or makes one importable)."""
    stem = name.lstrip("_").removeprefix("editable_impl_")
    return stem.startswith(OURS)


BUILD = """
import os, sys
from hatchling.build import build_wheel
out, *projects = sys.argv[1:]
for project in projects:
    os.chdir(project)
    print(build_wheel(out))
"""
"""Program that builds wheels of many hatchling projects in one process, as pip does for each."""


def build_wheels(projects: Sequence[Path], out: Path) -> list[Path]:
    """Build a wheel of each project with the build backend of the running environment."""
    done = subprocess.run(
        [sys.executable, "-c", BUILD, str(out), *map(str, projects)], check=True, capture_output=True, text=True
    )
    return [out / name for name in done.stdout.split()]


@dataclass
class FreshEnvironment:
    """A virtual environment of its own."""

    prefix: Path

    @property
    def python(self) -> Path:
        return self.prefix / "bin" / "python"

    def pip_install(self, *wheels: Path) -> None:
        """Have the environment's own pip install the wheels."""
        subprocess.run(
            [str(self.python), "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--no-compile",
             "--disable-pip-version-check", *map(str, wheels)],
            check=True, capture_output=True, **self._surroundings({}),
        )  # fmt: skip

    def install(self, *wheels: Path) -> None:
        """Unpack wheels without scripts, as pip does, in a tenth of its time."""
        (site,) = self.prefix.glob("lib/python*/site-packages")
        for wheel in wheels:
            with zipfile.ZipFile(wheel) as content:
                content.extractall(site)

    def clone(self, prefix: Path) -> FreshEnvironment:
        """Make an environment with the same distributions at another place, in a tenth of the time."""
        shutil.copytree(self.prefix, prefix, symlinks=True)
        for script in (prefix / "bin").iterdir():
            if not script.is_symlink():  # its first line names the interpreter
                script.write_text(script.read_text().replace(str(self.prefix), str(prefix)))
        return FreshEnvironment(prefix)

    def run(self, *args: str, check: bool = True, **env: str) -> subprocess.CompletedProcess[str]:
        """Run `sw ARGS` there, away from the source tree."""
        done = subprocess.run(self._command(args), **self._surroundings(env), capture_output=True, timeout=1200)
        if check and done.returncode:
            raise AssertionError(f"sw {' '.join(args)} exited {done.returncode}:\n{done.stdout}\n{done.stderr}")
        return done

    def run_each(self, commands: Iterable[Sequence[str]]) -> list[Done]:
        """Run `sw ARGS` of each one after the other in one process there."""
        return [Done(*each) for each in json.loads(self.python_c(EACH, given=json.dumps([*commands])))]

    def python_c(self, program: str, *args: str, given: str = "") -> str:
        """What a program prints in its interpreter, away from the source tree; AssertionError if it fails."""
        done = subprocess.run(
            [str(self.python), "-c", program, *args], **self._surroundings({}), capture_output=True, timeout=1200,
            input=given,
        )  # fmt: skip
        if done.returncode:
            raise AssertionError(f"the program exited {done.returncode}:\n{done.stdout}\n{done.stderr}")
        return str(done.stdout)

    def _command(self, args: Sequence[str]) -> list[str]:
        return [str(self.prefix / "bin" / "sw"), *args]

    def _surroundings(self, env: dict[str, str]) -> dict[str, Any]:
        work = self.prefix / "work"
        work.mkdir(exist_ok=True)
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "SW_", "COVERAGE"))}
        return {"cwd": work, "env": {**kept, "OMP_NUM_THREADS": "1", **env}, "text": True}

    def plugins(self, **env: str) -> dict[str, dict[str, object]]:
        """`sw list-plugins --json`, by distribution."""
        listed = json.loads(self.run("list-plugins", "--json", **env).stdout)
        return {p["distribution"]: p for p in listed["plugins"]}


def make_environment(prefix: Path) -> FreshEnvironment:
    venv.create(prefix, with_pip=False, symlinks=True)
    target = next(prefix.glob("lib/python*/site-packages"))
    sources = {Path(sysconfig.get_path("purelib")), Path(sysconfig.get_path("platlib"))}
    for source in sources:
        for entry in source.iterdir():
            if not is_ours(entry.name) and entry.suffix != ".pth" and not (target / entry.name).exists():
                (target / entry.name).symlink_to(entry)
    return FreshEnvironment(prefix)
