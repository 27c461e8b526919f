"""Published figures beside a measurement: which are meant, and in what their protocols differ."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from sw_report.commands import value_of
from sw_report.facts import RunFacts
from sw_report.numbers import FIELD_LPIPS, count
from sw_report.published_files import Figure

METRICS: Mapping[str, str] = {"psnr": "psnr", "ssim": "ssim", "lpips": FIELD_LPIPS}
"""Figure -> the metric of ours that computes it as the published one."""
OTHERWISE = "paper"
"""Preset of the runs that stand for a figure whose own preset nobody ran."""


class HasPreset(Protocol):
    @property
    def preset(self) -> str | None: ...


Run = TypeVar("Run", bound=HasPreset)


@dataclass(frozen=True)
class Beside:
    """A published figure beside a measurement of the same method.

    same_rate       whether the measurement's rate point is the published one
    differences     between the protocols, in words
    """

    figure: Figure
    same_rate: bool
    differences: tuple[str, ...]


UNPUBLISHED_SPLITS = ("sparse:", "sector:", "block:")
"""Beginnings of splits that published figures do not stand beside: views are numbered or chosen otherwise there."""


def beside(facts: RunFacts, scene: str | None, figures: Sequence[Figure]) -> list[Beside]:
    """Find the figures of a run's method for a scene of its data set (None: the mean over it).

    Where its rate point has a published one, those alone; else all of the method. None beside splits that hold out
    places, which no paper has.
    """
    if str(facts.rules().get("split", "")).removeprefix("file+").startswith(UNPUBLISHED_SPLITS):
        return []
    of_method = [f for f in figures if (f.method, f.dataset, f.scene) == (facts.method, facts.dataset, scene)]
    same = [f for f in of_method if f.rate is not None and f.rate == facts.rate]
    return [Beside(f, bool(same), tuple(differences(facts, f))) for f in same or of_method]


def standing_for(preset: str | None, runs: Sequence[Run]) -> list[Run]:
    """Select of a figure's runs those of the preset that it is to be measured by, else those of `paper`."""
    return [run for run in runs if run.preset == preset] or [run for run in runs if run.preset == OTHERWISE]


def differences(facts: RunFacts, figure: Figure) -> list[str]:
    """Name what differs between a run and a published figure: pictures, split, background, steps, values, and so on."""
    found = []
    rules, protocol = facts.rules(), figure.protocol
    for name, published in protocol.rules.items():
        here = rules.get(name)
        if here is not None and here not in (published if isinstance(published, list) else [published]):
            there = " or ".join(map(str, published)) if isinstance(published, list) else published
            found.append(f"{name} {here} here, {there} there")
    size = facts.speed.image_size
    if protocol.size is not None and size is not None and size != protocol.size:
        found.append(f"pictures {'x'.join(map(str, size))} here, {'x'.join(map(str, protocol.size))} there")
    if None not in (protocol.test_views, facts.test_views) and facts.test_views != protocol.test_views:
        found.append(f"{facts.test_views} test views here, {protocol.test_views} there")
    found += [f"{what} not stated there" for what in protocol.unstated]
    steps = steps_of(facts)
    if None not in (steps, figure.steps) and steps != figure.steps:
        found.append(f"{count(steps)} steps here, {count(figure.steps)} there")
    if figure.rate is None:
        found.append("no rate point of ours is the published one")
    elif facts.rate != figure.rate:
        found.append(f"rate point {facts.rate} here, {figure.rate} there")
    for key, _, wanted in (text.partition("=") for text in figure.sets):
        here = value_of(facts.config or {}, key)
        if key not in protocol.rules and key != "iterations" and here is not None and _text(here) != wanted:
            found.append(f"{key} {_text(here)} here, {wanted} there")
    found += [f"no {name.upper()} here" for name, metric in METRICS.items()
              if getattr(figure, name) is not None and facts.mean(metric) is None]  # fmt: skip
    return found + figure.differs


def steps_of(facts: RunFacts) -> int | None:
    """Steps of a training together with those of the scenes that it started from; None if one is not known."""
    each = [facts.train.steps, *(scene.steps for scene in (facts.train.pretraining or {}).values())]
    return None if None in each else sum(n for n in each if n is not None)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
