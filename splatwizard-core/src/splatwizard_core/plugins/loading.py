"""From entry points to plugin modules: which are installed, and whether what they need is there."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from email.message import Message
from email.parser import HeaderParser

from packaging.requirements import InvalidRequirement, Requirement

from splatwizard_core.plugins.catalogue import CORE, is_ours, normal_name, our_distributions, superseded
from splatwizard_core.plugins.guards import one_line
from splatwizard_core.plugins.migration import KEPT, PAGE, changed_since, written_for

log = logging.getLogger(__name__)

CORE_KEY = "core"  # entry point of the core itself: it loads first and whatever SW_PLUGINS says


@dataclass
class PluginInfo:
    """One installed distribution that has a `splatwizard` entry point.

    key     name of its entry point
    error   why it could not be loaded, or None
    foreign it is installed and none of ours
    """

    key: str
    distribution: str
    version: str
    module: str
    error: str | None = None
    foreign: bool = False

    @property
    def is_core(self) -> bool:
        """Whether it is the core itself, and not only called so."""
        return self.key == CORE_KEY and not self.foreign


def plugin_info(entry_point: importlib.metadata.EntryPoint) -> PluginInfo:
    """Facts of a plugin before it is imported."""
    header, dist = _header(entry_point.dist), entry_point.dist
    nameless = f"{entry_point.name} (without metadata)"  # an entry point that is called like one of ours is not it
    name = " ".join((header["Name"] or (entry_point.name if dist is None else nameless)).split())
    version = " ".join((header["Version"] or "").split())
    foreign = dist is not None and not is_ours(name)
    return PluginInfo(entry_point.name, name, version, entry_point.value, foreign=foreign)


def installed_entry_points(group: str) -> list[importlib.metadata.EntryPoint]:
    """Entry points of all installed distributions; one whose list cannot be read is left out with a warning."""
    try:
        return list(importlib.metadata.entry_points(group=group))
    except Exception:  # of a single one, which hides all others
        found: list[importlib.metadata.EntryPoint] = []
        backwards = reversed(list(importlib.metadata.distributions()))  # so that the first on the path is taken
        for name, dist in {_header(d)["Name"] or str(d.locate_file("")): d for d in backwards}.items():
            try:
                found += dist.entry_points.select(group=group)
            except Exception as error:
                log.warning("entry_points.txt of %s cannot be read: %s", name, one_line(error))
        return found


@functools.cache
def _places(path: tuple[str, ...]) -> dict[str, dict[tuple[str, str], None]]:
    """Normalised name of a distribution -> its folders and versions, by names of folders, in the order of `path`."""
    places: dict[str, dict[tuple[str, str], None]] = {}
    for folder in dict.fromkeys(path):
        with contextlib.suppress(OSError):  # a zip file, a folder that is gone
            for name in sorted(os.listdir(folder or ".")):
                if name.endswith((".dist-info", ".egg-info")):
                    distribution, _, version = name.rpartition(".")[0].partition("-")
                    places.setdefault(normal_name(distribution), {})[folder, version] = None
    return places


def shadowed() -> list[str]:
    """Return a line about each distribution of ours that lies on the path twice, or is superseded and still there."""
    places = _places(tuple(sys.path))
    told = []
    for name in sorted(our_distributions() & places.keys()):
        (first, used), *others = places[name]
        for folder, version in others:
            told.append(f"{name} {used} in {first} hides {name} {version} in {folder}: remove the wrong one")
    for name in sorted(superseded().keys() & places.keys()):
        now, (folder, version) = superseded()[name], next(iter(places[name]))
        cure = f"uninstall it, then pip install --force-reinstall --no-deps {now}"
        told.append(f"{name} {version} in {folder} is not used, it is part of {now} now: {cure}")
    return told


def taken_key(info: PluginInfo, plugins: Sequence[PluginInfo]) -> str | None:
    """One line about whose the name of a stranger's entry point is; None: its own."""
    key = normal_name(info.key)
    ours = next((name for name in our_distributions() if name.partition("-")[2] == key), None)
    others = sorted(p.distribution for p in plugins if p is not info and normal_name(p.key) == key)
    if not (info.foreign and (ours or others)):
        return None
    cure = f"uninstall {info.distribution}, or have its author rename it" if ours else "uninstall one of them"
    return f"its entry point is called '{info.key}', which is the name of {ours or ' and '.join(others)}: {cure}"


def taken_module(dist: importlib.metadata.Distribution | None) -> str | None:
    """One line about a module of ours that a stranger's distribution brings; None: it brings none."""
    with contextlib.suppress(UnicodeDecodeError, OSError):
        brought = {line.partition("/")[0] for line in ((dist and dist.read_text("RECORD")) or "").splitlines()}
        for ours in sorted(name for name in our_distributions() if name.replace("-", "_") in brought):
            module, name = ours.replace("-", "_"), _header(dist)["Name"]
            return f"it brings the module {module}, that of {ours}: uninstall {name}, then install {ours} again"
    return None


def names_of(entry_point: importlib.metadata.EntryPoint) -> set[str]:
    """Names that a user may call a plugin: its entry point, its distribution; normalised."""
    return {normal_name(name) for name in (entry_point.name, _header(entry_point.dist)["Name"]) if name}


def unmet_requirement(dist: importlib.metadata.Distribution | None) -> str | None:
    """The first dependency of `dist` that is not installed, or not in a version that it takes, with the cure."""
    for text in _header(dist).get_all("Requires-Dist", []):
        try:
            requirement, applies = _requirement(text)
        except InvalidRequirement:
            return f"its metadata requires {text[:80]!r}, which cannot be read: have its author mend `dependencies`"
        if not applies:
            continue
        name = superseded().get(normal_name(requirement.name), requirement.name)
        try:
            version = _installed_version(name)
        except importlib.metadata.PackageNotFoundError:
            part = "" if name == requirement.name else f"part of {name} now and "
            return f"needs {requirement.name}, which is {part}not installed: pip install {name}"
        # Our packages go on serving those that were written for the contract before this one.
        kept = is_ours(name) and requirement.specifier.contains(KEPT)
        if not (kept or requirement.specifier.contains(version, prereleases=True)):
            wanted = f"{requirement.name}{requirement.specifier}"
            if normal_name(requirement.name) == CORE and (contract := written_for([text])):
                since, ways = changed_since(contract), f"pip install --upgrade {_header(dist)['Name']}"
                return f"it is written for {CORE} {contract} ({wanted}), here is {version}: {since} ({PAGE}): {ways}"
            return f"needs {wanted}, but {version} is installed: pip install '{wanted}'"
    return None


def _header(dist: importlib.metadata.Distribution | None) -> Message:
    """The metadata of a distribution without its description, which takes most of the time to parse.

    Empty for one whose metadata is missing or no text.
    """
    text = None
    with contextlib.suppress(UnicodeDecodeError, OSError):
        text = dist and (dist.read_text("METADATA") or dist.read_text("PKG-INFO"))
    return _parsed((text or "").partition("\n\n")[0])


_parsed = functools.cache(HeaderParser().parsestr)  # each is asked for its name, its version and its requirements


@functools.cache
def _requirement(text: str) -> tuple[Requirement, bool]:
    """A requirement, most of which many packages share, and whether it holds here and without extras."""
    requirement = Requirement(text)
    return requirement, requirement.marker is None or requirement.marker.evaluate({"extra": ""})


@functools.cache
def _installed_version(distribution: str) -> str:
    """Version of a distribution, looked up once: plugins need the same few. Raises PackageNotFoundError."""
    if found := [v for _, v in _places(tuple(sys.path)).get(normal_name(distribution), ()) if v]:
        return found[0]  # importlib.metadata would look through all folders for each
    dist = importlib.metadata.distribution(distribution)
    return _header(dist)["Version"] or dist.version
