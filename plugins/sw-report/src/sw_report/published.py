"""Published figures, each with its source, its protocol and its year, as `published.json` beside this file has them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from splatwizard_core.api import UserInputError
from sw_report.commands import value_of
from sw_report.facts import RunFacts
from sw_report.numbers import FIELD_LPIPS, count

FILE = Path(__file__).with_name("published.json")
METRICS: Mapping[str, str] = {"psnr": "psnr", "ssim": "ssim", "lpips": FIELD_LPIPS}
"""Figure -> the metric of ours that computes it as the published one."""
OTHERWISE = "paper"
"""Preset of the runs that stand for a figure whose own preset nobody ran."""


class HasPreset(Protocol):
    @property
    def preset(self) -> str | None: ...


Run = TypeVar("Run", bound=HasPreset)


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PublishedProtocol(Strict):
    """Conditions of a published figure.

    text        in words
    rules       rule of a record's protocol -> the published value, or those that it may have
    unstated    what the source does not say
    size        width and height of the pictures, pixels
    """

    text: str
    rules: dict[str, str | int | list[str]] = {}
    unstated: list[str] = []
    size: tuple[int, int] | None = None
    test_views: int | None = None


class Figure(Strict):
    """One published row.

    variant     name of the rate at its source; rate: the rate point of ours that is meant, None: there is none
    scene       None: the mean over the data set
    psnr, ..., gaussians    as published, PSNR in dB, primitives as submitted; None: not published
    steps       of the whole training, all stages; None: not known
    differs     what differs from a measurement of ours whatever is done
    verified    False: second-hand, or recalled and not re-read
    preset, sets, images    how a run here comes closest; without a preset it is not run
    """

    method: str
    variant: str
    rate: str | None
    dataset: str
    scene: str | None
    psnr: float | None
    ssim: float | None
    lpips: float | None
    bytes: int | None
    gaussians: int | None
    steps: int | None
    protocol: PublishedProtocol
    differs: list[str]
    source: str
    year: int
    verified: bool
    preset: str | None = None
    sets: list[str] = []
    images: str = ""

    @property
    def label(self) -> str:
        """Method, and the name of the rate at its source."""
        return f"{self.method}, {self.variant}" if self.variant else self.method


@cache
def read_published(path: Path = FILE) -> tuple[Figure, ...]:
    """Read a file of figures. Raises UserInputError that names the first one whose fields are wrong."""
    content = json.loads(path.read_text("utf-8"))
    found = []
    for number, values in enumerate(content["figures"], 1):
        try:
            found.append(Figure(**{**values, "protocol": content["protocols"][values["protocol"]]}))
        except KeyError as error:
            raise UserInputError(f"{path}, figure {number}: no {error}") from None
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise UserInputError(f"{path}, figure {number}: {where}: {first['msg']}") from None
    return tuple(found)


@dataclass(frozen=True)
class Beside:
    """A published figure beside a measurement of the same method.

    same_rate       whether the measurement's rate point is the published one
    differences     between the protocols, in words
    """

    figure: Figure
    same_rate: bool
    differences: tuple[str, ...]


def beside(facts: RunFacts, scene: str | None, figures: Sequence[Figure]) -> list[Beside]:
    """Find the figures of a run's method for a scene of its data set (None: the mean over it).

    Where its rate point has a published one, those alone; else all of the method.
    """
    of_method = [f for f in figures if (f.method, f.dataset, f.scene) == (facts.method, facts.dataset, scene)]
    same = [f for f in of_method if f.rate is not None and f.rate == facts.rate]
    return [Beside(f, bool(same), tuple(differences(facts, f))) for f in same or of_method]


def standing_for(preset: str | None, runs: Sequence[Run]) -> list[Run]:
    """Select of a figure's runs those of the preset that it is to be measured by, else those of `paper`."""
    return [run for run in runs if run.preset == preset] or [run for run in runs if run.preset == OTHERWISE]


def differences(facts: RunFacts, figure: Figure) -> list[str]:
    """Name what differs between a run and a published figure: pictures, split, background, steps, values, and so on."""
    found = []
    rules, protocol = facts.protocol.rules(), figure.protocol
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
