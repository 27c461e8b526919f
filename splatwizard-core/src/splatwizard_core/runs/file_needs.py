"""Compare the needs of a file with what is installed: the missing or too old plugin, and the command that brings it."""

from __future__ import annotations

import importlib.metadata

from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.coding.requirements import Requirement, requirement_of
from splatwizard_core.errors import PluginError
from splatwizard_core.plugins import PluginManager
from splatwizard_core.plugins.catalogue import CORE, normal_name, package_of


def missing_parts(reader: ContainerReader, plugins: PluginManager) -> list[tuple[str, str]]:
    """List (kind, name) of the parts that the file was written with and nothing here provides.

    What several installed plugins quarrel over is not missing.
    """
    registries = plugins.registries
    there = {(kind, name) for kind, each in registries.items() for name in (*each.names, *each.clashes)}
    parts = [("method", reader.method), *(part for each in reader.requires for part in each.provided)]
    return [part for part in dict.fromkeys(parts) if part not in there]


def missing_plugin(reader: ContainerReader, plugins: PluginManager, kind: str, name: str) -> PluginError:
    """Make the error for a file that needs what nothing here provides.

    The package to install is the one of ours that provides it, else the one that the file names.
    """
    verb = "was written by" if kind == "method" else "needs"
    problem = f"{reader.name} {verb} {kind} '{name}', which is not installed"
    requirement = requirement_of(reader.requires, kind, name)
    ours = package_of(kind, name)
    if ours is not None and (requirement is None or normal_name(requirement.distribution) != normal_name(ours)):
        return PluginError(f"{problem}: pip install {ours}")
    if requirement is None:
        broken = [p.distribution for p in plugins.broken]
        if broken:
            problem += f" (or does not load: {', '.join(broken)}, see `sw list-plugins`)"
        return PluginError(f"{problem}: install the package that provides it (`sw list-plugins` shows what is there)")
    if kind not in plugins.registries:
        command = upgrade_command(reader, CORE, importlib.metadata.version(CORE))
        return PluginError(f"{reader.name} needs a {kind}, which {CORE} does not know: {command}")
    mine = [p for p in plugins.plugins if normal_name(p.distribution) == normal_name(requirement.distribution)]
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
    """List distributions that the file was written with and that are older here, with the version that is installed."""
    installed = {normal_name(plugin.distribution): plugin.version for plugin in plugins.plugins}
    pairs = [(each, installed.get(normal_name(each.distribution))) for each in reader.requires]
    return [(each, have) for each, have in pairs if have and each.is_newer_than(have)]


def upgrade_command(reader: ContainerReader, distribution: str, installed: str) -> str:
    """Return the command that gets a version of `distribution` which reads the file."""
    named = [each for each in reader.requires if normal_name(each.distribution) == normal_name(distribution)]
    newer = (each.command for each in named if each.is_newer_than(installed))
    return next(newer, f"pip install --upgrade {distribution}")
