"""Versions of the distributions that made a thing, and those of them that are another version now."""

from __future__ import annotations

import functools
import importlib.metadata
from collections.abc import Iterable, Mapping

from packaging.requirements import Requirement

from splatwizard_core.plugins import Entry, PluginManager
from splatwizard_core.plugins.catalogue import CORE, installed_version, is_ours, normal_name, superseded


def made_by(plugins: PluginManager, entries: Iterable[Entry]) -> dict[str, str]:
    """Map distribution to version, of the core, of all that these entries come from, and of our libraries below."""
    providers = {entry.distribution for entry in entries} - {""}
    return installed(plugins, providers.union(*map(_libraries, providers)))


def installed(plugins: PluginManager, distributions: Iterable[str]) -> dict[str, str]:
    """Map distribution to version as installed, the core's too; "" for one that is not there any more."""
    loaded = {plugin.distribution: plugin.version for plugin in plugins.plugins}
    return {name: loaded.get(name) or installed_version(name) for name in sorted({CORE, *distributions} - {""})}


def providers(plugins: PluginManager, *kinds: str) -> list[str]:
    """List the distributions that provide anything of these kinds."""
    return sorted({entry.distribution for kind in kinds for entry in plugins.registries[kind]})


def changes(plugins: PluginManager, before: Mapping[str, str]) -> list[str]:
    """List what was made by another version than is installed, such as `sw-x 0.1, now 0.2`; `before` as of `made_by`.

    A distribution that was not noted is no change.
    """
    now = installed(plugins, [superseded().get(name, name) for name in before])
    told = []
    for name, was in before.items():
        home = superseded().get(name, name)
        if home != name or now[home] != was:
            part = "" if home == name else f"part of {home} "
            told.append(f"{name} {was}, now {f'{part}{now[home]}' if now[home] else 'not installed'}")
    return told


@functools.cache
def _libraries(distribution: str) -> frozenset[str]:
    """Find the distributions of ours that one requires, and those that they require: libraries have no entries."""
    found: set[str] = set()
    unseen = [distribution]
    while unseen:
        try:
            lines = importlib.metadata.requires(unseen.pop()) or []
        except importlib.metadata.PackageNotFoundError:
            continue
        for requirement in map(Requirement, lines):
            name = normal_name(requirement.name)
            needed = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
            if needed and name not in found and is_ours(name):
                found.add(name)
                unseen.append(name)
    return frozenset(found)
