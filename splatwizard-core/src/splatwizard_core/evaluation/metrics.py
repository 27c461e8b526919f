"""Metrics: how they are declared, what settings a user gives them, and how each gets ready for an evaluation.

A metric is registered in one of two forms. The plain one is the callable itself, (render, truth) -> float. One that
needs a network, or anything else to be loaded, is an object with `prepare(setup) -> PreparedMetric`, called once
before the first view.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor

from splatwizard_core.errors import CapabilityError, ConfigError, PluginError
from splatwizard_core.plugins.guards import one_line
from splatwizard_core.plugins.registry import Entry, TypedRegistry
from splatwizard_native import ForeseenError

if TYPE_CHECKING:
    from pydantic import BaseModel

T = TypeVar("T")
SettingsT = TypeVar("SettingsT", bound="BaseModel")

Metric = Callable[[Tensor, Tensor], float]
"""(render [3,H,W], truth [3,H,W]), both in 0..1 on one device -> the value."""
MetricSettings = Mapping[str, Mapping[str, Any]]
"""Group -> key -> value, as `metrics.GROUP.KEY=VALUE` gives them."""
MISSING = ("weights-missing", "package-missing")
"""How the reason begins where something has to be brought; commands tell how, once, before the work."""


@dataclass(frozen=True)
class MetricInfo:
    """The fields that the entry of a metric declares.

    label       heading in tables, "PSNR"; the metric's name where none is declared
    group       its settings are `metrics.GROUP.KEY`; the metric's name where none is declared
    unit        "dB", or empty
    digits      after the decimal point, in tables
    direction   "higher" or "lower" is better
    diagnostic  computed to tell conventions apart, not for tables
    slow        left out of evaluations during a training; a slow diagnostic is computed only where it is named
    unrounded   gets the render as it is, not rounded to 8 bit
    pixelwise   gets pictures [3,1,n] of the pixels inside the mask, where the protocol cuts pictures out
    settings    "module:Model", the pydantic model of its settings; empty: it has none
    over        "image"; or "views" (where they lie) and "model": (Subject) -> MetricResult, None: does not apply
    """

    label: str
    group: str
    unit: str = ""
    digits: int = 4
    direction: str = "higher"
    diagnostic: bool = False
    slow: bool = False
    unrounded: bool = False
    pixelwise: bool = False
    settings: str = ""
    over: str = "image"

    @classmethod
    def of(cls, entry: Entry) -> MetricInfo:
        """The fields of one entry; what else it declares is passed over."""
        known = {f.name for f in dataclasses.fields(cls)} & entry.declared.keys()
        return cls(**{"label": entry.name, "group": entry.name, **{name: entry.declared[name] for name in known}})


@dataclass
class MetricSetup:
    """Device and settings that metrics get ready with.

    device      where the images will be
    settings    of all metrics, by group; a metric reads its own with `read`
    """

    device: torch.device
    settings: MetricSettings = field(default_factory=dict)
    _shared: dict[str, Any] = field(default_factory=dict, repr=False)

    def read(self, model: type[SettingsT], group: str) -> SettingsT:
        """The settings of a group. Raises ConfigError for a key that `model` does not have, or a bad value."""
        from pydantic import ValidationError

        given = self.settings.get(group, {})
        for key in given:
            if key not in model.model_fields:
                raise _unknown(f"{group}.{key}", [f"{group}.{known}" for known in model.model_fields])
        try:
            return model.model_validate(dict(given))
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(["metrics", group, *map(str, first["loc"])])
            reason = first["msg"].removeprefix("Value error, ")
            raise ConfigError(f"bad value {first['input']!r} for '{key}': {reason}", key=key) from None

    def share(self, key: str, make: Callable[[], T]) -> T:
        """The object that `make` returns, made once for all metrics of this evaluation that ask under the same key."""
        if key not in self._shared:
            self._shared[key] = make()
        found: T = self._shared[key]
        return found


@dataclass(frozen=True)
class PreparedMetric:
    """A metric that is ready.

    compute     the metric itself
    made_with   what its values depend on besides the images: package version, weights and their checksum
    verified    False: `made_with` names something that is not the published one; the record is flagged
    """

    compute: Metric
    made_with: Mapping[str, str] = field(default_factory=dict)
    verified: bool = True


@runtime_checkable
class MetricFactory(Protocol):
    """A metric that has to get ready.

    It may also have `unavailable(setup) -> str | None`: one line for the user, before the work, if it cannot be
    computed here. That raises UserInputError for settings that name something which is not there.
    """

    def prepare(self, setup: MetricSetup) -> PreparedMetric:
        """Load what is needed. Raises CapabilityError if something is missing, UserInputError if it is damaged."""
        ...

    def identity(self, setup: MetricSetup) -> str | None:
        """Cheap description of what `prepare` would find: a step is done again when it changes. None: it would fail."""
        ...


AnyMetric = Metric | MetricFactory | Callable[[Any], Any]
"""The target of a metric's entry; of one over views or models, the last."""


def quick_metrics(registry: TypedRegistry[AnyMetric]) -> list[str]:
    """Names of the metrics that are computed during training: the quick ones whose value the log is read for."""
    return [e.name for e in registry if not ((of := MetricInfo.of(e)).diagnostic or of.slow or of.over != "image")]


def chosen_metrics(registry: TypedRegistry[Any], names: Iterable[str] | None, *, geometry: bool) -> list[Entry]:
    """The metrics named (None: all but slow diagnostics and those over models), with `geometry` those over models."""
    infos = {entry.name: MetricInfo.of(entry) for entry in registry}
    usual = [n for n, of in infos.items() if of.over != "model" and not (of.slow and of.diagnostic)]
    wanted = [*(usual if names is None else names), *(n for n in infos if geometry and infos[n].over == "model")]
    return [registry.entry(name) for name in dict.fromkeys(wanted)]


def check_settings(registry: TypedRegistry[AnyMetric], settings: MetricSettings) -> dict[str, dict[str, Any]]:
    """The settings that were given, as their metrics' models understand them: plain values that JSON can hold.

    Raises ConfigError for a group or key that no installed metric has, with the nearest one, and for a bad value.
    """
    ours_last = sorted(registry, key=lambda e: not e.foreign)  # a group of ours stays ours
    models = {MetricInfo.of(e).group: e for e in ours_last if MetricInfo.of(e).settings}
    checked: dict[str, dict[str, Any]] = {}
    for group, given in settings.items():
        if group not in models:
            raise _unknown(f"{group}.{next(iter(given), '')}".rstrip("."), list(models))
        entry = models[group]
        model = dataclasses.replace(entry, target=MetricInfo.of(entry).settings).load()
        read = MetricSetup(torch.device("cpu"), settings).read(model, group)
        checked[group] = read.model_dump(mode="json", include=set(given))
    return checked


def _unknown(key: str, known: list[str]) -> ConfigError:
    near = difflib.get_close_matches(key, known, n=1) or difflib.get_close_matches(key.partition(".")[0], known, n=1)
    keys = ", ".join(f"metrics.{each}" for each in sorted(known))
    hint = f"did you mean 'metrics.{near[0]}'?" if near else f"there are settings for {keys or 'no installed metric'}"
    return ConfigError(f"unknown key 'metrics.{key}': {hint}", key=f"metrics.{key}")


def unavailable(entries: Iterable[Entry], setup: MetricSetup) -> list[str]:
    """One line for each thing that keeps some of these metrics from being computed here.

    Raises UserInputError for settings that name something which is not there.
    """
    lines: dict[str, str] = {}
    for entry in entries:
        try:
            ask = getattr(entry.load(), "unavailable", None)
        except PluginError:  # the record tells why it cannot be imported
            continue
        with noting_failure(entry, lines):
            line = ask(setup) if callable(ask) else None
            if line is not None:
                lines[entry.name] = str(line)
    return list(dict.fromkeys(lines.values()))


def prepare_metric(entry: Entry, setup: MetricSetup) -> PreparedMetric:
    """The metric of an entry, ready. Raises what its import or its `prepare` raises."""
    target = entry.load()
    return target.prepare(setup) if isinstance(target, MetricFactory) else PreparedMetric(target)


def measured(entry: Entry, metric: PreparedMetric, render: Tensor, truth: Tensor) -> float:
    """The value of a metric; one of a stranger gets copies of the images, so that it spoils no other's."""
    if not entry.foreign:
        return float(metric.compute(render, truth))
    copies = render.clone(), truth.clone()
    value = float(metric.compute(*copies))
    if not (torch.equal(copies[0], render) and torch.equal(copies[1], truth)):
        raise ValueError("it changes the images that it is given")
    return value


@contextlib.contextmanager
def noting_failure(entry: Entry, reasons: dict[str, str]) -> Iterator[None]:
    """Note under the metric's name why it has no value: what it says itself, or, where it broke, package and error.

    Raises the error itself if it is for the user (damaged weights), or about a GPU without memory; not a stranger's.
    """
    try:
        with entry.held():
            yield
    except (PluginError, CapabilityError) as error:
        reasons[entry.name] = str(error)
    except (Exception, SystemExit) as error:
        if isinstance(error, (ForeseenError, torch.cuda.OutOfMemoryError)) and not entry.foreign:
            raise
        reasons[entry.name] = f"{entry.whose} failed: {one_line(error)}"


def metric_identities(entries: Iterable[Entry], setup: MetricSetup) -> dict[str, str | None]:
    """name -> what its values would depend on now, cheaply told; None: it cannot be computed now."""
    found: dict[str, str | None] = {}
    for entry in entries:
        found[entry.name] = package = f"{entry.distribution} {entry.version}"
        try:
            target = entry.load()
            if hasattr(target, "identity"):
                with entry.held():
                    identity = target.identity(setup)
                found[entry.name] = None if identity is None else f"{package}, {identity}"
        except (Exception, SystemExit):
            found[entry.name] = None
    return found


def short_reason(reason: str) -> str:
    """Short reason why a metric has no value, for a table below a warning that has told how to mend it."""
    return next((word for word in MISSING if reason.startswith(word)), reason)
