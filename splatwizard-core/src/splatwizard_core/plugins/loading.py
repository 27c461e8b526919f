"""From entry points to plugin modules: which are installed, and whether what they need is there."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
from dataclasses import dataclass
from email.message import Message
from email.parser import HeaderParser

from packaging.requirements import InvalidRequirement, Requirement

from splatwizard_core.plugins.catalogue import normal_name


@dataclass
class PluginInfo:
    """One installed distribution that has a `splatwizard` entry point.

    key     name of its entry point
    error   why it could not be loaded, or None
    """

    key: str
    distribution: str
    version: str
    module: str
    error: str | None = None


def plugin_info(entry_point: importlib.metadata.EntryPoint) -> PluginInfo:
    """Facts of a plugin before it is imported."""
    header = _header(entry_point.dist)
    return PluginInfo(entry_point.name, header["Name"] or entry_point.name, header["Version"] or "", entry_point.value)


def names_of(entry_point: importlib.metadata.EntryPoint) -> set[str]:
    """Names that a user may call a plugin: its entry point, its distribution; normalised."""
    return {normal_name(name) for name in (entry_point.name, _header(entry_point.dist)["Name"]) if name}


def unmet_requirement(dist: importlib.metadata.Distribution | None) -> str | None:
    """The first dependency of `dist` that is not installed, or not in a version that it takes, with the cure."""
    for text in _header(dist).get_all("Requires-Dist", []):
        try:
            requirement = Requirement(text)
        except InvalidRequirement:
            continue
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            version = _installed_version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            return f"needs {requirement.name}, which is not installed: pip install {requirement.name}"
        if not requirement.specifier.contains(version, prereleases=True):
            wanted = f"{requirement.name}{requirement.specifier}"
            return f"needs {wanted}, but {version} is installed: pip install '{wanted}'"
    return None


def _header(dist: importlib.metadata.Distribution | None) -> Message:
    """The metadata of a distribution without its description, which takes most of the time to parse.

    Empty for one whose metadata is missing or no text.
    """
    text = None
    with contextlib.suppress(UnicodeDecodeError):
        text = dist and (dist.read_text("METADATA") or dist.read_text("PKG-INFO"))
    return HeaderParser().parsestr((text or "").partition("\n\n")[0])


@functools.cache
def _installed_version(distribution: str) -> str:
    """Version of a distribution, looked up once: plugins need the same few. Raises PackageNotFoundError."""
    found = importlib.metadata.distribution(distribution)
    return _header(found)["Version"] or found.version
