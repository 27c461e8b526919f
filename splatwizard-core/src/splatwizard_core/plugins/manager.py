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
from splatwizard_core.plugins import hookspecs, loading
from splatwizard_core.plugins.catalogue import normal_name, superseded
from splatwizard_core.plugins.guards import guarded_hooks, one_line, prints_to_stderr
from splatwizard_core.plugins.loading import PluginInfo
from splatwizard_core.plugins.migration import migration_hint
from splatwizard_core.plugins.registry import Coders, Entry, Registry, TypedRegistry
from splatwizard_core.plugins.strangers_code import strangers_code
from splatwizard_native import ForeseenError

if TYPE_CHECKING:
    from pathlib import Path

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
    from splatwizard_core.training.density import DensityControl
    from splatwizard_core.training.pruner import Pruner

log = logging.getLogger(__name__)


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
        self.density_controls: TypedRegistry[Callable[..., DensityControl]] = TypedRegistry("density control")
        self.methods: TypedRegistry[type[Method]] = TypedRegistry("method")
        self.datasets: TypedRegistry[type[Dataset] | Dataset] = TypedRegistry("dataset")
        self.metrics: TypedRegistry[AnyMetric] = TypedRegistry("metric")
        self.exporters: TypedRegistry[Callable[..., None]] = TypedRegistry("exporter")
        self.importers: TypedRegistry[Callable[..., GaussianModel]] = TypedRegistry("importer")
        self.executors: TypedRegistry[Any] = TypedRegistry("executor")
        self.checks: TypedRegistry[Callable[[], list[Check]]] = TypedRegistry("check")
        self.downloads: TypedRegistry[Callable[[], bytes]] = TypedRegistry("download")
        self.commands: TypedRegistry[click.Command] = TypedRegistry("command")
        # Each attribute is filled by the hook of its name.
        own = {name: each for name, each in vars(self).items() if isinstance(each, Registry)}
        self._filled_by = {f"register_{name}": registry for name, registry in own.items()}
        self.registries: dict[str, Registry] = {r.kind: r for r in self._filled_by.values()}
        self._pluggy = pluggy.PluginManager(hookspecs.PROJECT)
        self._pluggy.add_hookspecs(hookspecs)
        self._loaded: list[tuple[PluginInfo, object]] = []
        chosen = _chosen(entry_points, only)
        self.plugins += [info for info, _ in chosen]
        for info, entry_point in chosen:
            self._load(info, entry_point)
        for hook, registry in self._filled_by.items():
            getattr(self._pluggy.hook, hook)(registry=registry)
        for info, hooks in self._loaded:
            if info.error is not None:  # nothing is left of a plugin that failed half way
                self._pluggy.unregister(hooks)
                for registry in self.registries.values():
                    registry._withdraw(info.distribution)
        for info in filter(lambda each: each.is_core, self.broken):  # without it there is no command and no metric
            log.warning("%s %s cannot be loaded: %s", info.distribution, info.version, info.error)

    def _load(self, info: PluginInfo, entry_point: importlib.metadata.EntryPoint) -> None:
        hooks = None
        try:
            obstacle = loading.taken_key(info, self.plugins) or loading.unmet_requirement(entry_point.dist)
            obstacle = obstacle or (loading.taken_module(entry_point.dist) if info.foreign else None)
            if obstacle is not None:
                raise PluginError(obstacle)
            with self._held(info, registering=True):
                module = entry_point.load()
            hooks = guarded_hooks(module, self._pluggy, functools.partial(self._guard, info))
            self._pluggy.register(hooks)
            self._pluggy.check_pending()
            self._loaded.append((info, hooks))
        except (Exception, SystemExit) as error:  # a module that exits when it is imported must not end `sw`
            if self._pluggy.is_registered(hooks):  # with some of its hooks
                self._pluggy.unregister(hooks)
            info.error = one_line(error) + migration_hint(info.distribution, error)
            log.debug("plugin %s could not be loaded", info.distribution, exc_info=True)

    @contextlib.contextmanager
    def _guard(self, info: PluginInfo, hook: str, arguments: Iterable[Any]) -> Iterator[None]:
        """Let a hook implementation fail alone.

        Of a plugin that fails to register, everything is taken back and the reason recorded; any other failure is told.
        """
        registering = hook in self._filled_by
        for argument in arguments:
            if isinstance(argument, Registry):
                argument._owner = (info.distribution, info.version, info.foreign)
        try:
            with self._held(info, registering=registering, prints=hook == "run_finished"):  # that one prints tables
                yield
        except (Exception, SystemExit) as error:
            log.debug("plugin %s: %s failed", info.distribution, hook, exc_info=True)
            if not registering:
                log.warning("%s %s: %s failed: %s", info.distribution, info.version, hook, one_line(error))
                return
            info.error = f"{hook}: {one_line(error)}{migration_hint(info.distribution, error)}"

    @staticmethod
    def _held(info: PluginInfo, *, registering: bool, prints: bool = False) -> contextlib.AbstractContextManager[Any]:
        """Around a plugin's module and hooks: what it prints stands in no output; a stranger changes nothing else."""
        if not info.foreign:
            return contextlib.nullcontext() if prints else prints_to_stderr()
        whose, package = f"{info.distribution} {info.version}", info.module.partition(":")[0].partition(".")[0]
        return strangers_code(whose, registering=package if registering else "", prints=prints)

    @contextlib.contextmanager
    def guarding(self, registry: Registry, name: str) -> Iterator[None]:
        """Make whatever an entry raises that is no error for users a PluginError that names its distribution."""
        entry = registry.entry(name)
        try:
            with entry.held():
                yield
        except (ForeseenError, OSError):
            raise
        except (Exception, SystemExit) as error:
            raise PluginError(f"{entry.whose} failed: {one_line(error)}") from error

    def read_gaussians(self, path: Path) -> GaussianModel:
        """Read explicit Gaussians by the importer whose suffix `path` has, else as .ply. Raises UserInputError."""
        name = self.importers.of_suffix(path) or "ply"
        with self.guarding(self.importers, name):
            return self.importers.load(name)(path)

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

    def refused_of(self, info: PluginInfo) -> list[tuple[Entry, str]]:
        """(entry, why) of what a plugin added in vain; all else that it added is there."""
        refused = [each for registry in self.registries.values() for each in registry.refused]
        return [(entry, why) for entry, why in refused if entry.distribution == info.distribution]

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
) -> list[tuple[PluginInfo, importlib.metadata.EntryPoint]]:
    """The plugins to load: the core, ours, others by name. Raises PluginError for one in `only` that is not there."""
    found = [(loading.plugin_info(each), each) for each in entry_points]
    found = [each for each in found if normal_name(each[0].distribution) not in superseded()]
    found.sort(key=lambda each: (not each[0].is_core, each[0].foreign, each[0].key, each[0].distribution))
    if only is None:
        return found
    # One that became part of another package is that one, as a distribution or by the name of its entry point.
    homes = {name: now for old, now in superseded().items() for name in (old, old.partition("-")[2])}
    only = {homes.get(normal_name(name), name) for name in only}
    unknown = [name for name in sorted(only) if not any(normal_name(name) in loading.names_of(e) for _, e in found)]
    if unknown:
        raise PluginError(
            f"SW_PLUGINS names '{', '.join(unknown)}', which is not installed; there are: "
            f"{', '.join(info.key for info, _ in found if not info.is_core) or 'no plugins'}"
        )
    chosen = {normal_name(name) for name in only}
    return [each for each in found if each[0].is_core or chosen & loading.names_of(each[1])]


@functools.cache
def load_plugins() -> PluginManager:
    """The installed plugins, found once per process.

    SW_PLUGINS=a,b restricts them, by the names of entry points or distributions (empty: the core alone). Raises
    PluginError for a name that is not installed.
    """
    names = os.environ.get("SW_PLUGINS")
    only = None if names is None else {n.strip() for n in names.split(",") if n.strip()}
    for line in loading.shadowed():
        log.warning("%s", line)
    return PluginManager(loading.installed_entry_points(hookspecs.ENTRY_POINT_GROUP), only)
