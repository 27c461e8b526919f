"""Providers of each phase of a run, with their versions: of each training stage, encoding, rendering, evaluating.

Kinds of a part are those of the registries ("rasterizer", "pruner",
"coder", ...) and "stage", a training stage by the distribution of its class: a method that takes over another's stage
shows there. A task is listed where it comes from another distribution than its stage.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence

from splatwizard_core.plugins import Entry, PluginManager
from splatwizard_core.plugins.origins import NOBODY, Origins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.facts import EncodingFacts, Measurement, TrainingFacts
from splatwizard_core.runs.record import PhaseBlock
from splatwizard_core.training.measurements import Provided
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers
from splatwizard_core.training.stage import Stage

TRAIN, ENCODE, RENDER, EVALUATE = "train", "encode", "render", "evaluate"


def part_of(entry: Entry) -> Provided:
    """Return a registry entry as a part."""
    return _part(entry.kind, entry.name, entry.distribution, entry.version)


def unique(parts: Iterable[Provided]) -> list[Provided]:
    """Return each part once, in the order in which they first came."""
    return list(dict.fromkeys(parts))


def named_parts(plugins: PluginManager, kind: str, names: Iterable[str]) -> list[Provided]:
    """Return things of a kind, given by name, as parts; one that is not installed any more has no distribution."""
    known = plugins.registries[kind]
    return unique(part_of(known.entry(name)) if name in known else _part(kind, name) for name in names)


def stage_parts(origins: Origins, stage: Stage, ppl: PipelineParams) -> list[Provided]:
    """Return the stage itself, and the tasks of its plan that come from elsewhere."""
    own = origins.of(stage)
    planned = [each for scheduler in build_schedulers(stage, ppl) for each in scheduler.registrations]
    owned = [(each.name, origins.of(each.task)) for each in planned]
    others = [_part("task", name, *owner) for name, owner in owned if owner not in (own, NOBODY)]
    return unique([_part("stage", stage.name, *own), *others])


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
        self._plugins, self._loaded, self._rasterizer = plugins, loaded, rasterizer
        origins = Origins(plugins)
        self._fixed = [stage_parts(origins, stage, ppl) for stage in stages]
        self._common: list[Provided] = []
        for entry in _without_methods(loaded):
            holders = [parts for stage, parts in zip(stages, self._fixed, strict=True) if _holds(stage, entry)]
            for parts in holders or [self._common]:
                parts.append(part_of(entry))
        self._mark = len(loaded)
        self._pending: list[Provided] = []

    def since_asked(self) -> list[Provided]:
        """Return the parts that served since this was last asked."""
        asked = map(part_of, _without_methods(self._loaded[self._mark :]))
        drawn = named_parts(self._plugins, "rasterizer", sorted(self._rasterizer.served))
        found = unique([*self._pending, *asked, *drawn])
        self._rasterizer.served.clear()
        self._mark, self._pending = len(self._loaded), []
        return found

    @contextlib.contextmanager
    def elsewhere(self) -> Iterator[None]:
        """Leave out the parts that another training asks for meanwhile."""
        self._pending = self.since_asked()
        yield
        self._mark = len(self._loaded)

    def phases(self, provided: Mapping[str, Sequence[Provided]]) -> list[PhaseBlock]:
        """Return the phases of the training.

        provided    stage name -> the parts that `since_asked` told during it
        """
        common = [_phase(TRAIN, self._common)] if self._common else []
        pairs = zip(self._fixed, provided.items(), strict=True)
        return [*common, *(_phase(f"{TRAIN}: {name}", [*fixed, *parts]) for fixed, (name, parts) in pairs)]


def phases_of_run(
    plugins: PluginManager, training: TrainingFacts, encoding: EncodingFacts, measured: Measurement
) -> list[PhaseBlock]:
    """Return all phases of a run from the facts of its steps."""
    computed = (name for name, m in measured.metrics.items() if m.per_view or m.mean is not None)
    return [
        *training.phases,
        _phase(ENCODE, encoding.parts),
        _phase(RENDER, named_parts(plugins, "rasterizer", measured.rasterizers.values())),
        _phase(EVALUATE, named_parts(plugins, "metric", computed)),
    ]


def _phase(name: str, parts: Iterable[Provided]) -> PhaseBlock:
    return PhaseBlock(phase=name, provided_by=unique(parts))


def _part(kind: str, name: str, distribution: str = "", version: str = "") -> Provided:
    return Provided(kind=kind, name=name, distribution=distribution, version=version)


def _without_methods(entries: Iterable[Entry]) -> list[Entry]:
    """Leave out methods: a stage that is borrowed from one says so itself."""
    return [entry for entry in entries if entry.kind != "method"]


def _holds(stage: Stage, entry: Entry) -> bool:
    """Whether an attribute of the stage is what the entry stands for, an object of it, or of its module."""
    target, module = entry.load(), entry.target.partition(":")[0]
    return any(
        value is target or (isinstance(target, type) and isinstance(value, target)) or type(value).__module__ == module
        for value in vars(stage).values()
    )
