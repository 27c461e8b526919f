"""Compare the needs of a file with what is installed: the missing or too old plugin, and the command that brings it."""

from __future__ import annotations

import importlib.metadata
from dataclasses import replace

from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.coding.requirements import requirement_of
from splatwizard_core.errors import PluginError
from splatwizard_core.plugins import PluginManager
from splatwizard_core.plugins.catalogue import CORE, catalogue, is_ours, normal_name
from splatwizard_core.plugins.versions import installed


def missing_plugin(reader: ContainerReader, plugins: PluginManager, kind: str, name: str) -> PluginError:
    """Make the error for a file that needs what nothing here provides.

    The package to install is the one of ours that provides it, else the one that the file names.
    """
    verb = "was written by" if kind == "method" else "needs"
    problem = f"{reader.name} {verb} {kind} '{name}', which is not installed"
    writer = requirement_of(reader.requires, kind, name)
    package = catalogue().get(kind, {}).get(name) or (None if writer is None else writer.distribution)
    if package is None:
        broken = [p.distribution for p in plugins.broken]
        if broken:
            problem += f" (or does not load: {', '.join(broken)}, see `sw list-plugins`)"
        return PluginError(f"{problem}: install the package that provides it (`sw list-plugins` shows what is there)")
    if kind not in plugins.registries:
        command = upgrade_command(reader, CORE, importlib.metadata.version(CORE))
        return PluginError(f"{reader.name} needs a {kind}, which {CORE} does not know: {command}")
    mine = [p for p in plugins.plugins if normal_name(p.distribution) == normal_name(package)]
    failed = next((p for p in mine if p.error is not None), None)
    if failed is not None:
        return PluginError(f"{problem}, since {failed.distribution} {failed.version} does not load: {failed.error}")
    have = installed(plugins, [package])[package]
    if not have:
        if writer is not None and normal_name(writer.distribution) == normal_name(package):
            return PluginError(f"{problem}: {writer.command} (the package that the file names)")
        return PluginError(f"{problem}: pip install {package}")
    if not mine:
        return PluginError(f"{problem}: {package} {have} is there, but SW_PLUGINS leaves it out")
    return PluginError(f"{problem}: {package} {have} does not provide it{other_versions(reader, plugins)}")


def other_versions(reader: ContainerReader, plugins: PluginManager) -> str:
    """Say in parentheses what wrote the file in another version than is here, which is older, and what helps; or "".

    Of packages of ours newer files alone count: each release reads what earlier ones wrote.
    """
    here = {normal_name(plugin.distribution): plugin.version for plugin in plugins.plugins if plugin.version}
    pairs = [(each, here[name]) for each in reader.requires if (name := normal_name(each.distribution)) in here]
    newer = [(each, have) for each, have in pairs if each.is_newer_than(have)]
    theirs = [(each, have) for each, have in pairs if not is_ours(each.distribution)]
    older = [(each, have) for each, have in theirs if replace(each, version=have).is_newer_than(each.version)]
    if not (newer or older):
        return ""
    relation, sign = ("newer", ">=") if newer else ("older", "==")
    told = "; ".join(f"{each.distribution} {each.version}, installed is {have}" for each, have in newer or older)
    wanted = " ".join(f"'{each.distribution}{sign}{each.version}'" for each, _ in newer or older)
    return f" (the file is {relation}: it was written with {told}: pip install {wanted})"


def upgrade_command(reader: ContainerReader, distribution: str, installed: str, method: str = "") -> str:
    """Return the command that gets what reads the file: `distribution`, or, if that is a stranger's and the file names
    another package for `method`, that one."""
    named = [each for each in reader.requires if normal_name(each.distribution) == normal_name(distribution)]
    writer = requirement_of(reader.requires, "method", method)
    if writer is not None and not (named or is_ours(distribution)):
        return f"{writer.command} (the package that the file names)"
    newer = (each.command for each in named if each.is_newer_than(installed))
    return next(newer, f"pip install --upgrade {distribution}")
