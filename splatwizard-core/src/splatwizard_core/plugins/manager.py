"""Composes what the installed plugins provide: each is loaded on its own, its hooks are called through pluggy."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import logging
import os
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

import pluggy

from splatwizard_core.errors import PluginError
from splatwizard_core.plugins import hookspecs
from splatwizard_core.plugins.catalogue import normal_name
from splatwizard_core.plugins.guards import guarded_hooks, one_line
from splatwizard_core.plugins.loading import PluginInfo, names_of, plugin_info, unmet_requirement
from splatwizard_core.plugins.registry import Coders, Entry, Registry, TypedRegistry

if TYPE_CHECKING:
    import click

    from splatwizard_core.coding.contracts import (
        ArrayCoder,
        ContextModel,
        EntropyCoder,
        EntropyModel,
        GaussianCodec,
        PositionCodec,
        Quantizer,
        VectorCoder,
    )
    from splatwizard_core.evaluation.metrics import AnyMetric
    from splatwizard_core.gaussians.model import GaussianModel
    from splatwizard_core.method import Method
    from splatwizard_core.plugins.check import Check
    from splatwizard_core.rendering.rasterizer import Rasterizer
    from splatwizard_core.scene.dataset import Dataset
    from splatwizard_core.training.pruner import Pruner

log = logging.getLogger(__name__)

CORE_KEY = "core"  # entry point of the core itself: it loads first and whatever SW_PLUGINS says


class PluginManager:
    """All registries, filled by the plugins that loaded. A broken plugin is recorded and harms nothing else.

    only    load no others than these (and the core), each named by its entry point or its distribution; raises
            PluginError for one that is not installed
    """

    def __init__(self, entry_points: Iterable[importlib.metadata.EntryPoint], only: set[str] | None = None) -> None:
        self.plugins: list[PluginInfo] = []
        self.rasterizers: TypedRegistry[Callable[[], Rasterizer]] = TypedRegistry("rasterizer")
        self.pruners: TypedRegistry[Callable[..., Pruner]] = TypedRegistry("pruner")
        self.quantizers: TypedRegistry[Callable[..., Quantizer]] = TypedRegistry("quantizer")
        self.entropy_models: TypedRegistry[Callable[..., EntropyModel]] = TypedRegistry("entropy model")
        self.context_models: TypedRegistry[Callable[..., ContextModel]] = TypedRegistry("context model")
        self.coders: TypedRegistry[Callable[..., Any]] = TypedRegistry("coder")
        self.entropy_coders: Coders[EntropyCoder] = Coders(self.coders, "symbols")
        self.position_codecs: Coders[PositionCodec] = Coders(self.coders, "positions")
        self.array_coders: Coders[ArrayCoder] = Coders(self.coders, "arrays")
        self.vector_coders: Coders[VectorCoder] = Coders(self.coders, "vectors")
        self.gaussian_codecs: Coders[GaussianCodec] = Coders(self.coders, "gaussians")
        self.tasks: TypedRegistry[Callable[..., Any]] = TypedRegistry("task")
        self.methods: TypedRegistry[type[Method]] = TypedRegistry("method")
        self.datasets: TypedRegistry[type[Dataset] | Dataset] = TypedRegistry("dataset")
        self.metrics: TypedRegistry[AnyMetric] = TypedRegistry("metric")
        self.exporters: TypedRegistry[Callable[..., None]] = TypedRegistry("exporter")
        self.importers: TypedRegistry[Callable[..., GaussianModel]] = TypedRegistry("importer")
        self.executors: TypedRegistry[Any] = TypedRegistry("executor")
        self.checks: TypedRegistry[Callable[[], list[Check]]] = TypedRegistry("check")
        self.downloads: TypedRegistry[Callable[[], bytes]] = TypedRegistry("download")
        self.commands: TypedRegistry[click.Command] = TypedRegistry("command")
        self._filled_by: dict[str, Registry] = {
            "register_rasterizers": self.rasterizers,
            "register_pruners": self.pruners,
            "register_quantizers": self.quantizers,
            "register_entropy_models": self.entropy_models,
            "register_context_models": self.context_models,
            "register_coders": self.coders,
            "register_tasks": self.tasks,
            "register_methods": self.methods,
            "register_datasets": self.datasets,
            "register_metrics": self.metrics,
            "register_exporters": self.exporters,
            "register_importers": self.importers,
            "register_executors": self.executors,
            "register_checks": self.checks,
            "register_downloads": self.downloads,
            "register_commands": self.commands,
        }
        self.registries: dict[str, Registry] = {r.kind: r for r in self._filled_by.values()}
        self._pluggy = pluggy.PluginManager(hookspecs.PROJECT)
        self._pluggy.add_hookspecs(hookspecs)
        self._loaded: list[tuple[PluginInfo, object]] = []
        for entry_point in _chosen(entry_points, only):
            self._load(entry_point)
        for hook, registry in self._filled_by.items():
            getattr(self._pluggy.hook, hook)(registry=registry)
        for info, hooks in self._loaded:
            if info.error is not None:  # nothing is left of a plugin that failed half way
                self._pluggy.unregister(hooks)
                for registry in self.registries.values():
                    registry._withdraw(info.distribution)

    def _load(self, entry_point: importlib.metadata.EntryPoint) -> None:
        info = plugin_info(entry_point)
        self.plugins.append(info)
        try:
            unmet = unmet_requirement(entry_point.dist)
            if unmet is not None:
                raise PluginError(unmet)
            hooks = guarded_hooks(entry_point.load(), self._pluggy, functools.partial(self._guard, info))
            self._pluggy.register(hooks, name=entry_point.name)
            try:
                self._pluggy.check_pending()
            except pluggy.PluginValidationError:
                self._pluggy.unregister(hooks)
                raise
        except (Exception, SystemExit) as error:  # a module that exits when it is imported must not end `sw`
            info.error = one_line(error)
            log.debug("plugin %s could not be loaded", info.distribution, exc_info=True)
        else:
            self._loaded.append((info, hooks))

    @contextlib.contextmanager
    def _guard(self, info: PluginInfo, hook: str, arguments: Iterable[Any]) -> Iterator[None]:
        """Let a hook implementation fail alone.

        Of a plugin that fails to register, everything is taken back and the reason recorded; any other failure is told.
        """
        registering = hook in self._filled_by
        for argument in arguments:
            if isinstance(argument, Registry):
                argument._owner = (info.distribution, info.version)
        try:
            yield
        except (Exception, SystemExit) as error:
            log.debug("plugin %s: %s failed", info.distribution, hook, exc_info=True)
            if not registering:
                log.warning("%s %s: %s failed: %s", info.distribution, info.version, hook, one_line(error))
                return
            info.error = f"{hook}: {one_line(error)}"

    @property
    def hook(self) -> pluggy.HookRelay:
        """The hooks, as pluggy calls them."""
        return self._pluggy.hook

    def provided_by(self, info: PluginInfo) -> list[Entry]:
        """Entries that one plugin added, clashing names included."""
        found: list[Entry] = []
        for registry in self.registries.values():
            clashing = [e for entries in registry.clashes.values() for e in entries]
            found += [e for e in [*registry, *clashing] if e.distribution == info.distribution]
        return found

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


def _chosen(
    entry_points: Iterable[importlib.metadata.EntryPoint], only: set[str] | None
) -> list[importlib.metadata.EntryPoint]:
    """The entry points to load, the core's first. Raises PluginError for a name in `only` that is not installed."""
    found = sorted(entry_points, key=lambda e: (e.name != CORE_KEY, e.name))
    if only is None:
        return found
    unknown = [name for name in sorted(only) if not any(normal_name(name) in names_of(e) for e in found)]
    if unknown:
        raise PluginError(
            f"SW_PLUGINS names '{', '.join(unknown)}', which is not installed; there are: "
            f"{', '.join(e.name for e in found if e.name != CORE_KEY) or 'no plugins'}"
        )
    chosen = {normal_name(name) for name in only}
    return [e for e in found if e.name == CORE_KEY or chosen & names_of(e)]


@functools.cache
def load_plugins() -> PluginManager:
    """The installed plugins, found once per process.

    SW_PLUGINS=a,b restricts them, by the names of entry points or distributions (empty: the core alone). Raises
    PluginError for a name that is not installed.
    """
    names = os.environ.get("SW_PLUGINS")
    only = None if names is None else {n.strip() for n in names.split(",") if n.strip()}
    return PluginManager(importlib.metadata.entry_points(group=hookspecs.ENTRY_POINT_GROUP), only)
