"""Packages that `sw new-plugin` writes, installed for a test without a build: sources and metadata on the path."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from pathlib import Path

from sw_kit.names import Names, legal_names
from sw_kit.new_plugin import write
from sw_kit.templates import Kind, kinds

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def write_package(root: Path, kind: Kind, names: Names) -> Path:
    """Write a package below `root`, with a folder of metadata beside its sources, as an installer leaves one."""
    target = root / names.distribution
    write(target, kind, names)
    describe(target)
    return target


def describe(target: Path) -> None:
    """Put the metadata of a package beside its sources."""
    project = tomllib.loads((target / "pyproject.toml").read_text("utf-8"))["project"]
    info = target / "src" / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    requires = "".join(f"Requires-Dist: {line}\n" for line in project["dependencies"])
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n{requires}\n"
    )
    groups = project["entry-points"].items()
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()) for group, points in groups]
    (info / "entry_points.txt").write_text("".join(lines))


def one_of_each(root: Path) -> dict[str, Path]:
    """Write a package of every kind: kind -> its folder."""
    return {name: write_package(root, kind, legal_names(f"try-{name}")) for name, kind in kinds().items()}


def environment(packages: Iterable[Path]) -> dict[str, str]:
    """The environment of a process in which these packages are installed."""
    sources = [str(package / "src") for package in packages]
    path = os.pathsep.join([*sources, *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path}
