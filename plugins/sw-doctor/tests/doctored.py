"""Machines for the tests of `sw doctor`: programs and distributions that are not what they seem."""

from __future__ import annotations

import textwrap
from pathlib import Path


def script(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(["#!/bin/sh", *lines]) + "\n")
    path.chmod(0o755)
    return path


def distribution(folder: Path, name: str, requires: tuple[str, ...] = (), extras: tuple[str, ...] = (), **modules: str):
    """An installed distribution as importlib.metadata sees it: modules and metadata in `folder`."""
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir(parents=True)
    lines = ["Metadata-Version: 2.1", f"Name: {name}", "Version: 1.0"]
    lines += [f"Provides-Extra: {extra}" for extra in extras] + [f"Requires-Dist: {text}" for text in requires]
    (info / "METADATA").write_text("\n".join(lines) + "\n")
    (info / "RECORD").write_text("".join(f"{module}.py,,\n" for module in modules))
    for module, source in modules.items():
        (folder / f"{module}.py").write_text(textwrap.dedent(source))
