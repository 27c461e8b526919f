"""Tell a package that is written for an older core so, and where what it lacks is now (`moved.json`, module -> module).

`moved.json` is the table of docs/migration.md, which says what else has changed.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import re
from collections.abc import Iterable
from importlib.resources import files

from packaging.requirements import InvalidRequirement, Requirement
from packaging.version import Version

from splatwizard_core.errors import PluginError
from splatwizard_core.plugins.catalogue import CORE, normal_name

KEPT = "0.2"
"""The older contract that this release still serves: its import paths are forwarded."""
CHANGED = {
    "0.1": "names of the core come from splatwizard_core.api, the rest from packages of its own, and hooks have changed"
}
PAGE = "docs/migration.md"


def changed_since(contract: str) -> str:
    """Say what has changed since a release of the core, such as "0.1"."""
    return CHANGED.get(contract, "packages were joined, and some modules have moved")


def written_for(requires: Iterable[str]) -> str:
    """Return the release of the core, "0.1", that requirements name as the lowest, if that is an older contract."""
    lowest: list[Version] = []
    for line in requires:
        with contextlib.suppress(InvalidRequirement):
            if normal_name((found := Requirement(line)).name) == CORE:
                bounds = (
                    each.version.removesuffix(".*")
                    for each in found.specifier
                    if each.operator not in ("<", "<=", "!=")
                )
                lowest += map(Version, bounds)
    here = Version(importlib.metadata.version(CORE))
    older = lowest and max(lowest).release[:2] < here.release[:2]
    return ".".join(map(str, max(lowest).release[:2])) if older else ""


def migration_hint(distribution: str, error: BaseException) -> str:
    """Return what to add to the reason why a package fails: "" unless it is written for an older contract."""
    if isinstance(error, PluginError):  # which says what is wrong
        return ""
    requires: list[str] = []
    with contextlib.suppress(Exception):  # no such distribution, or no metadata that can be read
        requires = importlib.metadata.requires(distribution) or []
    contract = written_for(requires)
    lacks = re.search(r"No module named '([\w.]+)'", str(error)) if isinstance(error, ImportError) else None
    moved: dict[str, str] = json.loads(files(__package__).joinpath("moved.json").read_text("utf-8")) if lacks else {}
    now = moved.get(lacks[1]) if lacks else None
    if not (contract or now):
        return ""
    core = f"{CORE} {contract}" if contract else f"an older {CORE}"
    changed = f"{lacks[1]} is now {now}" if lacks and now else changed_since(contract or "0.1")
    return f"; it is written for {core}, here is {importlib.metadata.version(CORE)}: {changed} ({PAGE})"
