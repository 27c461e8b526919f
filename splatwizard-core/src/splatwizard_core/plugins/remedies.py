"""Advice to install something, as it works where it is read.

Messages say `pip install 'sw-geometry[mesh]'`. None of our distributions is on a package index, so what is shown names
the folder of the checkout, or of the wheels, that this installation came from, and the pip of this environment.
"""

from __future__ import annotations

import functools
import importlib.metadata
import json
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlparse

from splatwizard_core.base.toml_file import read_toml
from splatwizard_core.plugins.catalogue import CORE, installed_version, is_ours, normal_name

if TYPE_CHECKING:
    from packaging.requirements import Requirement

_OPTION, _SPEC = r"-{1,2}[\w-]+", r"'[^']+'|[A-Za-z0-9][\w.-]*[A-Za-z0-9](?:\[[\w,-]+\])?(?:[=<>~!]=?[\w.]+)?"
COMMAND = re.compile(rf"(?<![\w/.-])pip install((?: {_OPTION})*)((?: (?:{_SPEC}))+)")
WHEELS, PINS = "WHEELS", "constraints.txt"


def as_installed(text: str) -> str:
    """Return a text whose commands `pip install ...` are those of this installation."""
    if "pip install" not in text:
        return text
    root = checkout()
    pins = "" if root is None else f" -c {shlex.quote(_shown(root / PINS))}"
    return COMMAND.sub(_local, text).replace(f" -c {PINS}", pins)


def _local(found: re.Match[str]) -> str:
    from packaging.requirements import InvalidRequirement, Requirement

    options, words = found[1].strip(), re.findall(_SPEC, found[2])
    specs: list[Requirement] = []
    for word in words:  # the words of the sentence go on after the first that is none of ours
        try:
            spec = Requirement(word.strip("'"))
        except InvalidRequirement:
            break
        if specs and not (is_ours(spec.name) or spec.specifier or word.startswith("'")):
            break
        specs.append(spec)
    if "-e" in options.split() or not any(is_ours(spec.name) for spec in specs):  # -e: the folder is named already
        return found[0].replace("pip", pip(), 1)
    rest = "".join(f" {word}" for word in words[len(specs) :])
    root = checkout()
    if root is None:
        where = wheels()
        told = "" if where else f" ({WHEELS}: the folder of the wheels that {CORE} came from)"
        named = " ".join(f"'{spec}'" for spec in specs)
        return (
            " ".join(filter(None, [pip(), "install", options, "--find-links", shlex.quote(where or WHEELS), named]))
            + told
            + rest
        )
    newer = {"--upgrade"} == set(options.split()) or any(_is_newer(spec, root) for spec in specs)
    pull = f"git -C {shlex.quote(_shown(root))} pull && " if newer else ""
    here, others = sources(specs, root)
    parts = [f"-e {shlex.quote(path)}" for path in here] + [f"'{spec}'" for spec in others]
    options = " ".join(word for word in options.split() if word != "--upgrade")
    return pull + " ".join(filter(None, [pip(), "install", options, *parts])) + rest


def sources(specs: Iterable[Requirement], root: Path) -> tuple[list[str], list[Requirement]]:
    """Return the folders of a checkout, with extras, that bring these, and those that it does not hold.

    With each come those of ours that it needs and that are not installed: no index has them.
    """
    from packaging.requirements import Requirement

    found: dict[str, set[str]] = {}
    others, left = [], list(specs)
    while left:
        spec = left.pop(0)
        folder = folder_of(spec.name, root)
        if folder is None:
            others.append(spec)
            continue
        new = spec.extras - found.get(str(folder), set()) if str(folder) in found else {"", *spec.extras}
        found.setdefault(str(folder), set()).update(spec.extras)
        project = _project(folder)
        needs = project.get("dependencies", []) if "" in new else []
        needs = [*needs, *(line for extra in new for line in project.get("optional-dependencies", {}).get(extra, []))]
        for need in map(Requirement, needs):
            if is_ours(need.name) and (need.extras or not installed_version(need.name)):
                left.append(need)
    told = {_shown(Path(path)): ",".join(sorted(extras)) for path, extras in found.items()}
    return [path + (f"[{extras}]" if extras else "") for path, extras in told.items()], others


def folder_of(distribution: str, root: Path) -> Path | None:
    """Return the folder of one of our distributions in a checkout; None if it is not there."""
    name = normal_name(distribution)
    found = (root / name, root / "plugins" / name)
    return next((path for path in found if (path / "pyproject.toml").is_file()), None)


@functools.cache
def _origin() -> tuple[Path, bool] | None:
    """Return where the core was installed from, if pip noted it, and whether it is editable."""
    try:
        noted = json.loads(importlib.metadata.distribution(CORE).read_text("direct_url.json") or "null")
        path = Path(unquote(urlparse(noted["url"]).path))
        return path, bool(noted.get("dir_info", {}).get("editable"))
    except (ValueError, TypeError, KeyError, OSError, importlib.metadata.PackageNotFoundError):
        return None


def checkout() -> Path | None:
    """Return the root of the checkout that the core is installed from, editable; None: of no such."""
    found = _origin()
    return found[0].parent if found and found[1] and (found[0].parent / "plugins").is_dir() else None


def wheels() -> str | None:
    """Return the folder of the wheel that the core was installed from, if pip noted it and it is still there."""
    found = _origin()
    return _shown(found[0].parent) if found and found[0].suffix == ".whl" and found[0].parent.is_dir() else None


def pip() -> str:
    """Spell the pip of this environment."""
    own = Path(sys.prefix) / ("Scripts" if os.name == "nt" else "bin") / "pip"
    named = shutil.which("pip")
    if named is not None and Path(named) == own:
        return "pip"
    return shlex.quote(_shown(own)) if own.exists() else f"{shlex.quote(sys.executable)} -m pip"


def _shown(path: Path) -> str:
    """A path from here, where that is shorter than the whole."""
    try:
        return str(path.relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)


def _is_newer(spec: Requirement, root: Path) -> bool:
    """Whether a checkout is older than what is asked for."""
    folder = folder_of(spec.name, root)
    if folder is None or not spec.specifier:
        return False
    return not spec.specifier.contains(_project(folder)["version"], prereleases=True)


def _project(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = read_toml(folder / "pyproject.toml", "project")[0]["project"]
    return found
