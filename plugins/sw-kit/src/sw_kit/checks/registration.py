"""Checks of a package as it is installed and registered, which import none of what it provides."""

from __future__ import annotations

import functools
import importlib.metadata
import json
import subprocess
import sys
from typing import TYPE_CHECKING

from packaging.requirements import Requirement

from splatwizard_core.tooling import load_plugins
from sw_kit.checks.fields import check_entry
from sw_kit.checks.imports import imports_of
from sw_kit.finding import hold

if TYPE_CHECKING:
    from splatwizard_core.tooling import Entry, PluginInfo

CORE = "splatwizard-core"
MOST_LINES = 50_000
"""Lines of Python that registering may execute: a few thousand find the module, numpy alone would take 400,000."""
FACES = ("splatwizard_core.api", "splatwizard_core.tooling")


def check_loads(info: PluginInfo) -> str:
    """Hold a plugin to be loaded: it imports, its hooks do not raise, and none of its entries is refused."""
    hold(info.error is None, f"the plugin is broken: {info.error}", "mend that first; --debug shows a traceback")
    for entry, why in load_plugins().refused_of(info):
        hold(
            False,
            f"{entry.kind} '{entry.name}' is refused: {why}",
            "registry.add(...) with a name and fields of its own",
        )
    return f"{info.distribution} {info.version}, entry point '{info.key}'"


def check_requirements(info: PluginInfo) -> str:
    """Hold the metadata to state the core and everything else that is imported, each with the versions that fit."""
    listed = [Requirement(text) for text in importlib.metadata.requires(info.distribution) or []]
    by_name = {_normal(each.name): each for each in listed}
    line = f'dependencies = ["{CORE}>=X.Y,<X.Z"]'
    hold(CORE in by_name, f"it does not require {CORE}", f"pyproject.toml: {line}")
    operators = {spec.operator for spec in by_name[CORE].specifier}
    hold(
        operators & {">=", ">", "~=", "=="} and operators & {"<", "<=", "~=", "=="},
        f"it requires '{by_name[CORE]}', which has no lower or no upper bound",
        f"pyproject.toml: {line}: the core may change with X.Z",
    )
    loose = [str(each) for each in listed if not each.specifier and not each.url]
    hold(not loose, f"no version of {', '.join(loose)} is stated", "pyproject.toml: say since which version it works")
    return f"{len(listed)} dependencies, versions stated"


def check_imports(info: PluginInfo) -> str:
    """Hold every import of the core to one of its faces, and every other one to a distribution that it requires."""
    found = imports_of(info.module.partition(".")[0])
    inner = sorted(
        f"{name} ({where})"
        for name, where in found.items()
        if name.startswith("splatwizard_core.") and not f"{name}.".startswith(tuple(f"{face}." for face in FACES))
    )
    hold(not inner, f"it imports {', '.join(inner[:3])}", f"only {' and '.join(FACES)} are promised: import from there")
    declared = {_normal(Requirement(text).name) for text in importlib.metadata.requires(info.distribution) or []}
    declared.add(_normal(info.distribution))
    owners = _owners()
    undeclared: dict[str, str] = {}  # distribution -> a file that imports it
    for name, where in found.items():
        top = name.partition(".")[0]
        # An editable install tells no modules, so ours go by their names; what is not installed is optional.
        known = {_normal(top)} if top.startswith(("sw_", "splatwizard_")) else owners.get(top, set())
        if known and top != info.module.partition(".")[0] and not known & declared:
            undeclared.setdefault(min(known), where)
    hold(
        not undeclared,
        f"it imports {', '.join(f'{each} ({where})' for each, where in undeclared.items())} without requiring it",
        f"pyproject.toml: add {', '.join(map(repr, undeclared))} to dependencies (to an extra, if it is optional) and "
        "install again; that another package brings it today does not count",
    )
    return "through the core's faces and declared packages"


def check_light(info: PluginInfo) -> str:
    """Hold registration to be silent, without torch, and short: every `sw` command waits for it."""
    lines, torch, noise = _registered_alone(info.module)
    hold(not noise, f"registering prints {noise[:80]!r}", f"{info.module}: print nothing when it is imported")
    hold(not torch, "registering imports torch", f"{info.module}: import it inside what is registered")
    hold(
        lines <= MOST_LINES,
        f"registering executes {lines:,} lines of Python, at most {MOST_LINES:,} are allowed",
        f"{info.module}: import nothing but splatwizard_core.api",
    )
    return f"silent, without torch, {lines:,} lines of Python"


def check_fields(entries: list[Entry]) -> str:
    """Hold names, summaries and declared fields to what their kinds take."""
    for entry in entries:
        check_entry(entry)
    kinds = [entry.kind for entry in entries]
    counted = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    return counted or "registers nothing by name"


def _registered_alone(module: str) -> tuple[int, bool, str]:
    """Lines executed, whether torch was imported, and what was printed, of registering in a fresh process."""
    command = [sys.executable, "-m", "sw_kit.checks.registration_child", module]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    hold(done.returncode == 0, f"registering fails: {done.stderr.strip()[-300:]}", f"{module}: see the message")
    *noise, last = done.stdout.splitlines()
    told = json.loads(last)
    return told["lines"], told["torch"], "\n".join([*noise, done.stderr.strip()]).strip()


@functools.cache
def _owners() -> dict[str, set[str]]:
    """Importable top-level name -> the installed distributions that it is of; nothing of Python's own."""
    found = importlib.metadata.packages_distributions()
    return {top: set(map(_normal, of)) for top, of in found.items() if top not in sys.stdlib_module_names}


def _normal(name: str) -> str:
    return name.lower().replace("_", "-").replace(".", "-")
