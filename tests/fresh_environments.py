"""Fresh environments for tests that need really installed distributions, without a network.

A fresh environment has its own interpreter prefix and site-packages; third-party packages are linked in from
the running environment, ours are not: they come from wheels built here.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import venv
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WORKSPACE = [ROOT / "splatwizard-core", *sorted(p.parent for p in (ROOT / "plugins").glob("*/pyproject.toml"))]
OURS = ("splatwizard", "sw_", "sw-")


def is_ours(name: str) -> bool:
    """Whether a file in site-packages belongs to a workspace package (or makes one importable)."""
    stem = name.lstrip("_").removeprefix("editable_impl_")
    return stem.startswith(OURS)


def build_wheel(project: Path, out: Path) -> Path:
    """Build one wheel with the build backend of the running environment."""
    before = set(out.glob("*.whl"))
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "--no-index",
         "--disable-pip-version-check", "-w", str(out), str(project)],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    (wheel,) = set(out.glob("*.whl")) - before
    return wheel


@dataclass
class FreshEnvironment:
    """A virtual environment of its own."""

    prefix: Path

    @property
    def python(self) -> Path:
        return self.prefix / "bin" / "python"

    def install(self, *wheels: Path) -> None:
        subprocess.run(
            [sys.executable, "-m", "pip", "--python", str(self.python), "install", "-q", "--no-deps", "--no-index",
             "--disable-pip-version-check", *map(str, wheels)],
            check=True, capture_output=True, text=True,
        )  # fmt: skip

    def run(self, *args: str, check: bool = True, **env: str) -> subprocess.CompletedProcess[str]:
        """Run `sw ARGS` there, away from the source tree."""
        work = self.prefix / "work"
        work.mkdir(exist_ok=True)
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "SW_", "COVERAGE"))}
        done = subprocess.run(
            [str(self.prefix / "bin" / "sw"), *args],
            cwd=work, env={**kept, "OMP_NUM_THREADS": "2", **env}, capture_output=True, text=True, timeout=300,
        )  # fmt: skip
        if check and done.returncode:
            raise AssertionError(f"sw {' '.join(args)} exited {done.returncode}:\n{done.stdout}\n{done.stderr}")
        return done

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
