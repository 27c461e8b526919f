"""Providers of each phase of a run: of each stage of the training, of encoding and rendering, with their versions.

A part is {"kind", "name", "distribution", "version"}. Kinds are those of the registries ("rasterizer", "pruner",
"coder", ...) and "stage", a training stage by the distribution of its class: a method that takes over another's stage
shows there. A task is listed where it comes from another distribution than its stage.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from splatwizard_core.plugins import Entry, PluginManager
from splatwizard_core.plugins.origins import Origins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers
from splatwizard_core.training.stage import Stage

Part = dict[str, str]
TRAIN, ENCODE, RENDER = "train", "encode", "render"


def part_of(entry: Entry) -> Part:
    """Return a registry entry as a part."""
    return _part(entry.kind, entry.name, entry.distribution, entry.version)


def unique(parts: Iterable[Part]) -> list[Part]:
    """Return each part once, in the order in which they first came."""
    return list({tuple(part.values()): part for part in parts}.values())


def rasterizer_parts(plugins: PluginManager, names: Iterable[str]) -> list[Part]:
    """Return rasterizers, given by name, as parts; one that is not installed any more has no distribution."""
    registry = plugins.registries["rasterizer"]
    return unique(
        part_of(registry.entry(name)) if name in registry else _part("rasterizer", name, "", "") for name in names
    )


def stage_parts(origins: Origins, stage: Stage, ppl: PipelineParams) -> list[Part]:
    """Return the stage itself, and the tasks of its plan that come from elsewhere."""
    own = origins.of(stage)
    parts = [_part("stage", stage.name, *own)]
    for scheduler in build_schedulers(stage, ppl):
        for registration in scheduler.registrations:
            owner = origins.of(registration.task)
            if owner not in (own, ("", "")):
                parts.append(_part("task", registration.name, *owner))
    return unique(parts)


class StageParts:
    """The parts that serve each stage of a training, gathered while it runs.

    stages      of the method, just made
    loaded      entries that the registries were asked for, as it grows; making the stages has asked for those of now
    rasterizer  that the training renders with
    """

    def __init__(
        self,
        plugins: PluginManager,
        stages: Sequence[Stage],
        ppl: PipelineParams,
        loaded: list[Entry],
        rasterizer: NegotiatedRasterizer,
    ) -> None:
        self._plugins, self._stages, self._loaded, self._rasterizer = plugins, stages, loaded, rasterizer
        origins = Origins(plugins)
        self._fixed = [stage_parts(origins, stage, ppl) for stage in stages]
        self._common: list[Part] = []
        for entry in loaded:
            if entry.kind == "method":
                continue  # a stage that is borrowed from it says so itself
            holders = [i for i, stage in enumerate(stages) if _holds(stage, entry)]
            for i in holders:
                self._fixed[i].append(part_of(entry))
            if not holders:
                self._common.append(part_of(entry))
        self._mark = len(loaded)
        self._pending: list[Part] = []

    def since_asked(self) -> list[Part]:
        """Return the parts that served since this was last asked."""
        self._pending += [part_of(entry) for entry in self._loaded[self._mark :] if entry.kind != "method"]
        self._mark = len(self._loaded)
        self._pending += rasterizer_parts(self._plugins, sorted(self._rasterizer.served))
        self._rasterizer.served.clear()
        found, self._pending = unique(self._pending), []
        return found

    @contextlib.contextmanager
    def elsewhere(self) -> Iterator[None]:
        """Leave out the parts that another training asks for meanwhile."""
        self._pending = self.since_asked()
        try:
            yield
        finally:
            self._mark = len(self._loaded)

    def phases(self, provided: Mapping[str, Sequence[Part]]) -> list[dict[str, Any]]:
        """Return the phases of the training.

        provided    stage name -> the parts that `since_asked` told during it
        """
        found = [_phase(TRAIN, self._common)] if self._common else []
        for fixed, (name, parts) in zip(self._fixed, provided.items(), strict=True):
            found.append(_phase(f"{TRAIN}: {name}", [*fixed, *parts]))
        return found


def phases_of_run(
    plugins: PluginManager,
    training: Mapping[str, Any],
    encoding: Mapping[str, Any],
    rasterizers: Mapping[str, str],
) -> list[dict[str, Any]] | None:
    """Return all phases of a run from the facts of its steps; None if an older release did one, which noted none."""
    if "phases" not in training or "parts" not in encoding:
        return None
    return [
        *training["phases"],
        _phase(ENCODE, encoding["parts"]),
        _phase(RENDER, rasterizer_parts(plugins, rasterizers.values())),
    ]


def _phase(name: str, parts: Iterable[Part]) -> dict[str, Any]:
    return {"phase": name, "provided_by": unique(parts)}


def _part(kind: str, name: str, distribution: str, version: str) -> Part:
    return {"kind": kind, "name": name, "distribution": distribution, "version": version}


def _holds(stage: Stage, entry: Entry) -> bool:
    """Whether an attribute of the stage is what the entry stands for, an object of it, or of its module."""
    target, module = entry.load(), entry.target.partition(":")[0]
    return any(
        value is target or (isinstance(target, type) and isinstance(value, target)) or type(value).__module__ == module
        for value in vars(stage).values()
    )
