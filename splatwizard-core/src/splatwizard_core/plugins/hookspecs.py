"""The whole plugin surface: every hook that an installed distribution may implement.

A `register_*` hook gets a registry and adds light entries to it: a name, a lazy "module:attribute" target, a one-line
summary, and the fields that its kind declares. Nothing heavy is imported by a hook. Hooks are called through pluggy,
so `specname`, `tryfirst`, `trylast` and wrappers work as its documentation says.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import pluggy

if TYPE_CHECKING:
    from splatwizard_core.plugins.registry import Registry
    from splatwizard_core.runs.observers import FinishedRuns, StartedTraining, TrainingObserver
    from splatwizard_core.scene.scene import Scene

PROJECT = "splatwizard"
ENTRY_POINT_GROUP = "splatwizard"

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


REGISTERED = {
    "rasterizers": "Add rasterizers: classes or factories () -> Rasterizer, with the fields of RasterizerInfo.",
    "pruners": (
        "Add pruners: classes whose objects have score(model, cameras, rasterizer, background) -> [N], higher = keep."
    ),
    "quantizers": "Add quantizers: forward(x) for training; encode(x) and decode(...) exact on the lattice.",
    "entropy_models": "Add entropy models: bits(symbols, context), encode(symbols, context), decode(bytes, context).",
    "context_models": "Add context models: modules that predict entropy-model parameters from what is already decoded.",
    "coders": "Add coders: of symbols, positions, arrays, or whole Gaussian models, as the field `codes` declares.",
    "tasks": "Add schedule tasks: callables (or factories of them) whose annotations say what they need.",
    "density_controls": (
        "Add density controls: subclasses of splatwizard_core.api.DensityControl, made with their settings."
    ),
    "methods": "Add methods: subclasses of splatwizard_core.api.Method, with their presets and rate points.",
    "datasets": "Add dataset families: objects with detect(path) -> score and load(path, options) -> Scene.",
    "metrics": (
        "Add metrics: callables (render [3,H,W], truth [3,H,W]) -> float or factories of them; or `over` views, models."
    ),
    "exporters": "Add exporters: callables (model, path) that write an interchange format, with its file name suffix.",
    "importers": (
        "Add importers: callables (path) -> GaussianModel that read an interchange format, with its file name suffix."
    ),
    "executors": "Add executors: where the runs of a sweep happen (local processes, a cluster).",
    "checks": (
        "Add checks of the machine: callables () -> list[Check], each run in a process of its own when a user asks."
    ),
    "downloads": "Add downloads: callables () -> the registry of data sets (TOML bytes) that can be fetched.",
    "commands": (
        "Add subcommands of `sw`: click commands, imported when they are called; the summary is their line in the help."
    ),
}
"""Things that plugins provide -> what their hook `register_THINGS(registry)` does."""


def _registering(does: str) -> Any:
    def hook(registry: Registry) -> None: ...

    hook.__doc__ = does
    return hookspec(hook)


for _things, _does in REGISTERED.items():
    globals()[f"register_{_things}"] = _registering(_does)


@hookspec
def describe_scene(scene: Scene) -> Mapping[str, Any] | None:
    """Return facts of a scene as plain values, or None; `sw info SCENE` shows those of all plugins together."""


@hookspec
def run_started(training: StartedTraining) -> TrainingObserver | None:
    """Return an observer of a training that begins (a viewer, a logger), or None."""


@hookspec
def run_finished(runs: FinishedRuns) -> None:
    """Make something of finished runs: called after each (a page), and once after the last (tables, plots)."""
