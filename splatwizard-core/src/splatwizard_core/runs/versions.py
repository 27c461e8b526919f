"""Which versions of which distributions made a thing, and whether the same ones are installed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from splatwizard_core.plugins import Entry, PluginManager

CORE = "splatwizard-core"


def made_by(plugins: PluginManager, entries: Iterable[Entry]) -> dict[str, str]:
    """Distribution -> version of the core and of everything that these entries come from."""
    return installed(plugins, [entry.distribution for entry in entries])


def installed(plugins: PluginManager, distributions: Iterable[str]) -> dict[str, str]:
    """Distribution -> version as installed, the core's too; "" for one that is not there any more."""
    versions = {plugin.distribution: plugin.version for plugin in plugins.plugins}
    return {name: versions.get(name, "") for name in sorted({CORE, *distributions} - {""})}


def providers(plugins: PluginManager, *kinds: str) -> list[str]:
    """The distributions that provide anything of these kinds."""
    return sorted({entry.distribution for kind in kinds for entry in plugins.registries[kind]})


def changes(plugins: PluginManager, before: Any) -> list[str]:
    """What was made by another version than is installed, such as `sw-codecs 0.1, now 0.2`; `before` as of `made_by`.

    Nothing that can be read counts as a change too.
    """
    if not isinstance(before, Mapping):
        return ["versions that were not noted"]
    now = installed(plugins, map(str, before))
    return [
        f"{name} {version}, now {now[str(name)] or 'not installed'}"
        for name, version in before.items()
        if now[str(name)] != version
    ]
