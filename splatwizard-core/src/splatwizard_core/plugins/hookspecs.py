"""The whole plugin surface: what an installed distribution may provide.

Every hook gets a registry and adds light entries to it: a name, a lazy "module:attribute" target, a
one-line summary, and the fields that its kind declares. Nothing heavy is imported by a hook.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pluggy

if TYPE_CHECKING:
    import click

    from splatwizard_core.plugins.registry import Registry

PROJECT = "splatwizard"
ENTRY_POINT_GROUP = "splatwizard"

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def register_rasterizers(registry: Registry) -> None:
    """Add rasterizers: classes or factories () -> Rasterizer, with the fields of RasterizerInfo."""


@hookspec
def register_pruners(registry: Registry) -> None:
    """Add pruners: classes whose objects have score(model, cameras, rasterizer, background) -> [N], higher = keep."""


@hookspec
def register_quantizers(registry: Registry) -> None:
    """Add quantizers: forward(x) for training; encode(x) and decode(...) exact on the lattice."""


@hookspec
def register_entropy_models(registry: Registry) -> None:
    """Add entropy models: bits(symbols, context), encode(symbols, context), decode(bytes, context)."""


@hookspec
def register_context_models(registry: Registry) -> None:
    """Add context models: modules that predict entropy-model parameters from what is already decoded."""


@hookspec
def register_coders(registry: Registry) -> None:
    """Add entropy coders (symbols <-> bytes under a ModelSpec), position codecs, and coders of plain arrays."""


@hookspec
def register_tasks(registry: Registry) -> None:
    """Add schedule tasks: callables (or factories of them) whose annotations say what they need."""


@hookspec
def register_methods(registry: Registry) -> None:
    """Add methods: subclasses of splatwizard_core.experiments.method.Method."""


@hookspec
def register_datasets(registry: Registry) -> None:
    """Add dataset families: objects with detect(path) -> score and load(path, options) -> Scene."""


@hookspec
def register_metrics(registry: Registry) -> None:
    """Add image metrics: callables (render [3,H,W], truth [3,H,W]) -> float, or factories of them, with a direction."""


@hookspec
def register_exporters(registry: Registry) -> None:
    """Add exporters: callables (model, path) that write an interchange format."""


@hookspec
def register_executors(registry: Registry) -> None:
    """Add executors: where the runs of a sweep happen (local processes, a cluster)."""


@hookspec
def register_commands(cli: click.Group) -> None:
    """Add subcommands to `sw`."""
