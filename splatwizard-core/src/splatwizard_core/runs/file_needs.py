"""A file against what is installed: which plugin is missing or too old, and the command that brings it."""

from __future__ import annotations

import importlib.metadata
import re

from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.coding.requirements import Requirement, requirement_of
from splatwizard_core.errors import PluginError
from splatwizard_core.plugins import PluginManager


def missing_parts(reader: ContainerReader, plugins: PluginManager) -> list[tuple[str, str]]:
    """(kind, name) of what the file was written with and nothing here provides."""
    parts = [("method", reader.method), *(part for each in reader.requires for part in each.provided)]
    return [(kind, name) for kind, name in dict.fromkeys(parts) if _is_missing(plugins, kind, name)]


def _is_missing(plugins: PluginManager, kind: str, name: str) -> bool:
    """Whether no installed plugin provides it, not even several that quarrel over its name."""
    registry = plugins.registries.get(kind)
    return registry is None or not (name in registry or name in registry.clashes)


def missing_plugin(reader: ContainerReader, plugins: PluginManager, kind: str, name: str) -> PluginError:
    """The error for a file that needs what nothing here provides."""
    verb = "was written by" if kind == "method" else "needs"
    problem = f"{reader.name} {verb} {kind} '{name}', which is not installed"
    requirement = requirement_of(reader.requires, kind, name)
    if requirement is None:
        # The name comes from the file; the reader lets none through that a shell could misread.
        cure = (
            f"pip install sw-{name} (or the package that provides it)" if kind == "method" else "see `sw list-plugins`"
        )
        broken = [p.distribution for p in plugins.broken]
        if broken:
            problem += f" (or does not load: {', '.join(broken)}, see `sw list-plugins`)"
        return PluginError(f"{problem}: {cure}")
    if kind not in plugins.registries:
        core = "splatwizard-core"
        command = upgrade_command(reader, core, importlib.metadata.version(core))
        return PluginError(f"{reader.name} needs a {kind}, which {core} does not know: {command}")
    mine = [p for p in plugins.plugins if same_distribution(p.distribution, requirement.distribution)]
    failed = next((p for p in mine if p.error is not None), None)
    if failed is not None:
        return PluginError(f"{problem}, since {failed.distribution} {failed.version} does not load: {failed.error}")
    try:
        have = importlib.metadata.version(requirement.distribution)
    except importlib.metadata.PackageNotFoundError:
        return PluginError(f"{problem}: {requirement.command} (the package that the file names)")
    if requirement.is_newer_than(have):
        return PluginError(f"{problem}; {requirement.distribution} {have} is too old: {requirement.command}")
    if not mine:
        return PluginError(f"{problem}: {requirement.distribution} {have} is there, but SW_PLUGINS leaves it out")
    return PluginError(f"{problem}: {requirement.distribution} {have} no longer provides it")


def newer_than_installed(reader: ContainerReader, plugins: PluginManager) -> list[tuple[Requirement, str]]:
    """Distributions that the file was written with and that are older here, with the version that is installed."""
    found = []
    for requirement in reader.requires:
        for plugin in plugins.plugins:
            if same_distribution(plugin.distribution, requirement.distribution) and plugin.version:
                if requirement.is_newer_than(plugin.version):
                    found.append((requirement, plugin.version))
                break
    return found


def upgrade_command(reader: ContainerReader, distribution: str, installed: str) -> str:
    """How to get a version of `distribution` that reads the file."""
    for requirement in reader.requires:
        if same_distribution(requirement.distribution, distribution) and requirement.is_newer_than(installed):
            return requirement.command
    return f"pip install --upgrade {distribution}"


def same_distribution(one: str, other: str) -> bool:
    """Distribution names are compared without case, and with `-`, `_` and `.` alike (PEP 503)."""
    return re.sub(r"[-_.]+", "-", one).lower() == re.sub(r"[-_.]+", "-", other).lower()
