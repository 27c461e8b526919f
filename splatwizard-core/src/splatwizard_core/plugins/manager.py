"""Finds plugins through entry points, loads each on its own, and composes what they provide."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import logging
import os
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pluggy

from splatwizard_core.errors import PluginError
from splatwizard_core.plugins import hookspecs
from splatwizard_core.plugins.registry import Entry, Registry

if TYPE_CHECKING:
    import click

log = logging.getLogger(__name__)

KINDS = {
    "rasterizer": "register_rasterizers",
    "pruner": "register_pruners",
    "quantizer": "register_quantizers",
    "entropy model": "register_entropy_models",
    "context model": "register_context_models",
    "coder": "register_coders",
    "task": "register_tasks",
    "method": "register_methods",
    "dataset": "register_datasets",
    "metric": "register_metrics",
    "exporter": "register_exporters",
    "executor": "register_executors",
}


@dataclass
class PluginInfo:
    """One installed distribution that has a `splatwizard` entry point.

    error   why it could not be loaded, or None
    """

    key: str
    distribution: str
    version: str
    module: str
    error: str | None = None


class PluginManager:
    """All registries, filled by the plugins that loaded. A broken plugin is recorded and harms nothing else.

    only    load no others than these (and the core), each named by its entry point or its distribution; raises
            PluginError for one that is not installed
    """

    def __init__(self, entry_points: Iterable[importlib.metadata.EntryPoint], only: set[str] | None = None) -> None:
        self.plugins: list[PluginInfo] = []
        self.registries = {kind: Registry(kind) for kind in KINDS}
        self._pluggy = pluggy.PluginManager(hookspecs.PROJECT)
        self._pluggy.add_hookspecs(hookspecs)
        self._modules: list[tuple[PluginInfo, Any]] = []
        found = sorted(entry_points, key=lambda e: (e.name != "core", e.name))
        if only is not None:
            chosen = {_normal(name) for name in only}
            unknown = [name for name in sorted(only) if not any(_normal(name) in _names(e) for e in found)]
            if unknown:
                raise PluginError(
                    f"SW_PLUGINS names '{', '.join(unknown)}', which is not installed; there are: "
                    f"{', '.join(e.name for e in found if e.name != 'core') or 'no plugins'}"
                )
            found = [e for e in found if e.name == "core" or chosen & _names(e)]
        for entry_point in found:
            self._load(entry_point)

    def _load(self, entry_point: importlib.metadata.EntryPoint) -> None:
        dist = entry_point.dist
        info = PluginInfo(
            entry_point.name,
            dist.metadata["Name"] if dist else entry_point.name,
            dist.version if dist else "",
            entry_point.value,
        )
        self.plugins.append(info)
        try:
            for requirement in missing_requirements(dist):
                raise PluginError(f"needs {requirement}, which is not installed: pip install {requirement}")
            module = entry_point.load()
            self._pluggy.register(module, name=entry_point.name)
            self._pluggy.check_pending()
        except (Exception, SystemExit) as error:  # a module that exits when it is imported must not end `sw`
            reason = str(error) if isinstance(error, PluginError) else f"{type(error).__name__}: {error}"
            info.error = " ".join(reason.split())
            if self._pluggy.has_plugin(entry_point.name):
                self._pluggy.unregister(name=entry_point.name)
            log.debug("plugin %s could not be loaded", info.distribution, exc_info=True)
            return
        self._register(info, module)
        self._modules.append((info, module))

    def _register(self, info: PluginInfo, module: Any) -> None:
        """Call every hook of one plugin. If one fails, everything that the plugin added is taken back."""
        for kind, hook in KINDS.items():
            function: Callable[[Registry], None] | None = getattr(module, hook, None)
            if function is None:
                continue
            registry = self.registries[kind]
            registry._owner = (info.distribution, info.version)
            try:
                function(registry)
            except Exception as error:
                info.error = f"{hook}: {type(error).__name__}: {error}"
                for each in self.registries.values():
                    each._withdraw(info.distribution)
                return

    def provided_by(self, info: PluginInfo) -> list[Entry]:
        """What one plugin added, clashing names included."""
        found: list[Entry] = []
        for registry in self.registries.values():
            clashing = [e for entries in registry.clashes.values() for e in entries]
            found += [e for e in [*registry, *clashing] if e.distribution == info.distribution]
        return found

    def __getattr__(self, name: str) -> Registry:
        """`plugins.methods`, `plugins.rasterizers`, `plugins.entropy_models`, ..."""
        kind = re.sub("s$", "", name).replace("_", " ")
        registries: dict[str, Registry] = self.__dict__.get("registries", {})
        if kind in registries:
            return registries[kind]
        raise AttributeError(name)

    @contextlib.contextmanager
    def recording(self) -> Iterator[list[Entry]]:
        """The entries that a block asks any registry to load, in order, repetitions included."""
        record: list[Entry] = []
        for registry in self.registries.values():
            registry._recorders.append(record)
        try:
            yield record
        finally:
            for registry in self.registries.values():
                registry._recorders[:] = [each for each in registry._recorders if each is not record]

    @property
    def broken(self) -> list[PluginInfo]:
        """Those that could not be loaded, or whose hooks failed."""
        return [p for p in self.plugins if p.error is not None]

    def register_commands(self, cli: click.Group) -> None:
        """Let every plugin add its commands; one that fails is recorded as broken, `sw` works on."""
        for info, module in self._modules:
            function = getattr(module, "register_commands", None)
            if function is None or info.error is not None:
                continue
            try:
                function(cli)
            except Exception as error:
                info.error = f"register_commands: {type(error).__name__}: {error}"


def _normal(name: str) -> str:
    """Distribution names are compared without case, and with `-`, `_` and `.` alike (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _names(entry_point: importlib.metadata.EntryPoint) -> set[str]:
    """What a user may call a plugin: its entry point, its distribution."""
    dist = entry_point.dist
    return {_normal(name) for name in (entry_point.name, dist.metadata["Name"] if dist else None) if name}


def missing_requirements(dist: importlib.metadata.Distribution | None) -> list[str]:
    """The sw-* distributions that `dist` lists as (unconditional) dependencies and that are not installed."""
    missing = []
    for requirement in (dist.requires if dist else None) or []:
        spec, _, marker = requirement.partition(";")
        name = re.split(r"[ <>=!~\[(]", spec.strip(), maxsplit=1)[0]
        if marker.strip() or not name.startswith(("sw-", "sw_", "splatwizard-")):
            continue
        try:
            importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    return missing


@functools.cache
def load_plugins() -> PluginManager:
    """The installed plugins, found once per process.

    SW_PLUGINS=a,b restricts them, by the names of entry points or distributions (empty: the core alone). Raises
    PluginError for a name that is not installed.
    """
    names = os.environ.get("SW_PLUGINS")
    only = None if names is None else {n.strip() for n in names.split(",") if n.strip()}
    return PluginManager(importlib.metadata.entry_points(group=hookspecs.ENTRY_POINT_GROUP), only)
