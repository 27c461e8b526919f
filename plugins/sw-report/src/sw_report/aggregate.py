"""Means over the scenes of a data set: plain, and none where a scene is missing.

Source: evaluation protocol, aggregation. A mean over what happens to exist would compare different scenes.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

from sw_report.configurations import seed_of
from sw_report.declared import dataset_facts
from sw_report.numbers import ordered_metrics
from sw_report.runs import Run, natural


@dataclass(frozen=True)
class MeanRow:
    """A method at a rate point over the scenes of a data set.

    scenes      that it was run on, of those that count
    missing     those it lacks
    metrics     by name; None: a scene is missing (or its value unknown), and partial means were not asked for
    size        mean bytes, or None likewise
    counts      mean primitives by unit, or None likewise
    seeds       of each scene; 1 where the scenes have different ones
    deviations  standard deviation (n - 1) of a metric's mean over the scenes, over the seeds; empty for one seed
    """

    variant: str
    rate: str | None
    scenes: tuple[str, ...]
    missing: tuple[str, ...]
    metrics: dict[str, float | None]
    size: float | None
    counts: dict[str, float] | None
    seeds: int = 1
    deviations: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class DatasetTable:
    """One data set under one protocol.

    published   whether `scenes` are the published ones (else: all that the runs are of)
    protocols   ids; several only where they differ in nothing but the picture folder
    directions  metric -> "higher" or "lower", what is better
    """

    dataset: str
    title: str
    scenes: tuple[str, ...]
    published: bool
    protocols: tuple[str, ...]
    rows: list[MeanRow]
    directions: dict[str, str] = field(default_factory=dict)


def dataset_tables(runs: Sequence[Run], *, partial: bool = False, diagnostic: bool = False) -> list[DatasetTable]:
    """A table for each data set and protocol that has more than one scene.

    partial     means over the scenes that are there, the missing ones named
    diagnostic  with the metrics that tell conventions apart
    """
    tables = [_table(part, partial, diagnostic) for part in comparable(runs)]
    return [table for table in tables if len(table.scenes) > 1]


def comparable(runs: Sequence[Run]) -> list[list[Run]]:
    """Group the runs that may share a mean over scenes: of one data set, by one set of rules.

    Only the picture folder may differ between scenes, and then only within one named protocol: `survey` and `inria`
    read the same scenes of Mip-NeRF 360 from different folders.
    """
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.facts.dataset, run.facts.protocol_without_folder()), []).append(run)
    found = []
    for group in groups.values():
        several = len({run.facts.protocol.id for run in group}) > 1
        named: dict[str, list[Run]] = {}
        for run in group:
            named.setdefault(str(run.facts.rules().get("name")) if several else "", []).append(run)
        for part in named.values():
            found += _one_protocol_a_scene(part)
    return found


def _one_protocol_a_scene(group: Sequence[Run]) -> list[list[Run]]:
    """One part if every scene has one protocol; else the protocols apart."""
    by_scene: dict[str, set[str]] = {}
    for run in group:
        by_scene.setdefault(run.facts.scene, set()).add(run.facts.protocol.id)
    if all(len(ids) == 1 for ids in by_scene.values()):
        return [list(group)]
    apart: dict[str, list[Run]] = {}
    for run in group:
        apart.setdefault(run.facts.protocol.id, []).append(run)
    return list(apart.values())


def _table(runs: Sequence[Run], partial: bool, diagnostic: bool) -> DatasetTable:
    dataset = dataset_facts(runs[0].facts.dataset)
    scene_of = {run: dataset.scene_of(run.facts.scene) for run in runs}
    scenes = dataset.scenes or tuple(sorted(set(scene_of.values()), key=natural))
    rows: dict[tuple[str, str | None], dict[str, Run]] = {}
    for run, scene in scene_of.items():
        if scene in scenes:
            rows.setdefault((run.variant, run.facts.rate), {})[scene] = run
    names = ordered_metrics(
        name for run in runs for name in run.facts.metrics if diagnostic or not run.facts.is_diagnostic(name)
    )
    return DatasetTable(
        runs[0].facts.dataset,
        dataset.title,
        scenes,
        bool(dataset.scenes),
        tuple(dict.fromkeys(run.facts.protocol.id for run in runs)),
        sorted(
            (_row(variant, rate, by_scene, scenes, names, partial) for (variant, rate), by_scene in rows.items()),
            key=lambda row: (natural(row.variant), natural(row.rate or "")),
        ),
        {name: metric.direction for run in runs for name, metric in run.facts.metrics.items()},
    )


def _row(
    variant: str, rate: str | None, runs: dict[str, Run], scenes: Sequence[str], metrics: Sequence[str], partial: bool
) -> MeanRow:
    missing = tuple(scene for scene in scenes if scene not in runs)
    present = [runs[scene] for scene in scenes if scene in runs]
    whole = not missing or partial
    counts = None
    if whole and present and all(run.counts.keys() == present[0].counts.keys() for run in present):
        counts = {unit: mean([run.counts[unit] for run in present]) or 0.0 for unit in present[0].counts}
    seeds, deviations = 1, dict[str, float]()
    if whole and len({tuple(map(seed_of, run.seeds)) for run in present}) == 1:
        seeds = len(present[0].seeds)
        for name in metrics if seeds > 1 else ():
            by_seed = [mean([run.seeds[i].mean(name) for run in present], partial=partial) for i in range(seeds)]
            known = [value for value in by_seed if value is not None]
            if len(known) == seeds:
                deviations[name] = statistics.stdev(known)
    return MeanRow(
        variant,
        rate,
        tuple(scene for scene in scenes if scene in runs),
        missing,
        {name: mean([run.mean(name) for run in present], partial=partial) if whole else None for name in metrics},
        mean([run.size for run in present]) if whole else None,
        counts,
        seeds,
        deviations,
    )


def mean(values: Sequence[float | None], *, partial: bool = False) -> float | None:
    """Plain mean; None if one is unknown (partial: those are left out) or there is none."""
    known = [value for value in values if value is not None]
    if not known or (len(known) < len(values) and not partial):
        return None
    return sum(known) / len(known)
