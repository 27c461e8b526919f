"""Importing works on Windows and macOS: no module needs what Python has on Linux alone."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from import_graph import CORE, NATIVE, PACKAGES, files_of, module_name

UNIX_ONLY = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "posix", "syslog"}
"""Modules that Windows lacks."""
NAMES = {("signal", "SIGHUP"), ("os", "fork"), ("os", "getuid"), ("os", "sched_getaffinity")}
"""Names of modules that Windows, or macOS, lacks."""


def imported_at_once(path: Path) -> set[str]:
    """The modules that importing a file imports, those in functions left out."""
    tree = ast.parse(path.read_text("utf-8"))
    inside = {id(n) for f in ast.walk(tree) if isinstance(f, ast.FunctionDef | ast.Lambda) for n in ast.walk(f)}
    found = set()
    for node in (n for n in ast.walk(tree) if id(n) not in inside):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add((node.module or "").partition(".")[0])
    return found


@pytest.mark.parametrize("package", [NATIVE, CORE, *PACKAGES], ids=lambda p: p.name)
def test_no_module_imports_what_windows_lacks(package: Path):
    assert {p.name: found for p in files_of(package) if (found := imported_at_once(p) & UNIX_ONLY)} == {}


def test_the_core_imports_and_takes_its_streams_where_all_that_is_missing():
    """Every module of the base and the core, with those modules blocked and those names gone."""
    modules = [module_name(p, package) for package in (NATIVE, CORE) for p in files_of(package)]
    modules = [name for name in modules if not name.endswith(("__main__", "fresh_child"))]
    program = f"""
import importlib, os, signal, sys
import torch, psutil, filelock, click, rich.console, rich.progress, PIL.Image, safetensors.torch, pydantic
for name in {sorted(UNIX_ONLY)}:
    sys.modules[name] = None
for module, name in {sorted(NAMES)}:
    delattr(sys.modules[module], name)
for name in {modules}:
    importlib.import_module(name)
from splatwizard_core.cli.main import main
from splatwizard_core.base.interrupt import InterruptGuard
from splatwizard_native import available_cores
assert available_cores() >= 1
with InterruptGuard() as guard, guard.interruptible():
    pass
sys.exit(main(["list-plugins"]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-1500:]
    assert "core" in done.stdout


def test_the_peak_of_memory_is_asked_for_as_windows_tells_it(monkeypatch: pytest.MonkeyPatch):
    from types import SimpleNamespace

    from splatwizard_core.base import memory

    told = SimpleNamespace(memory_info=lambda: SimpleNamespace(peak_wset=123, rss=7))
    monkeypatch.setattr(memory, "_STATUS", Path("nowhere"))
    monkeypatch.setattr(memory.sys, "platform", "win32")
    monkeypatch.setattr(memory.psutil, "Process", lambda: told)
    assert memory.peak_rss_bytes() == 123
