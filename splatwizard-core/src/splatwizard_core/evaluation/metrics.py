"""From registry entries to metrics that can be called: what they need is fetched once an evaluation.

A metric is registered in one of two forms. The plain one is the callable itself, (render, truth) -> float. One that
needs a network, or anything else to be loaded, is an object with `prepare(setup) -> PreparedMetric`, called once
before the first view.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor

from splatwizard_core.errors import CapabilityError, PluginError
from splatwizard_core.plugins.registry import Entry, Registry

T = TypeVar("T")

Metric = Callable[[Tensor, Tensor], float]
"""(render [3,H,W], truth [3,H,W]), both in 0..1 on one device -> the value."""


MISSING = ("weights-missing", "package-missing")
"""How the reason begins where something has to be brought; commands tell how, once, before the work."""


@dataclass
class MetricSetup:
    """What metrics may use to get ready.

    device          where the images will be
    lpips_weights   folder that the user named for backbone weights; None: only the usual places are searched
    """

    device: torch.device
    lpips_weights: Path | None = None
    _shared: dict[str, Any] = field(default_factory=dict, repr=False)

    def share(self, key: str, make: Callable[[], T]) -> T:
        """What `make` returns, made once for all metrics of this evaluation that ask under the same key."""
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
    """A metric that has to get ready."""

    def prepare(self, setup: MetricSetup) -> PreparedMetric:
        """Load what is needed. Raises CapabilityError if something is missing, UserInputError if it is damaged."""
        ...

    def identity(self, setup: MetricSetup) -> str | None:
        """What `prepare` would find, as one cheap string: a step is done again when it changes. None: it would fail."""
        ...


def default_metrics(registry: Registry, *, on_the_way: bool = False) -> list[str]:
    """Names of the metrics that are computed when none are named: every one that is installed.

    on_the_way  during training: only the quick ones whose value the log is read for
    """
    if not on_the_way:
        return registry.names
    return [e.name for e in registry if not e.declared.get("diagnostic") and not e.declared.get("slow")]


def prepare_metrics(entries: Sequence[Entry], setup: MetricSetup) -> tuple[dict[str, PreparedMetric], dict[str, str]]:
    """The metrics that are ready, and of the others why not, both by name."""
    ready: dict[str, PreparedMetric] = {}
    missing: dict[str, str] = {}
    for entry in entries:
        try:
            target = entry.load()
            is_factory = isinstance(target, MetricFactory)
            ready[entry.name] = target.prepare(setup) if is_factory else PreparedMetric(target)
        except (PluginError, CapabilityError) as error:
            missing[entry.name] = str(error)
    return ready, missing


def metric_identities(registry: Registry, setup: MetricSetup) -> dict[str, str | None]:
    """name -> what its values would depend on now, cheaply told; None: it cannot be computed now."""
    found: dict[str, str | None] = {}
    for entry in registry:
        found[entry.name] = f"{entry.distribution} {entry.version}"
        if not entry.declared.get("slow"):
            continue
        try:
            target = entry.load()
        except PluginError:
            found[entry.name] = None
            continue
        if isinstance(target, MetricFactory):
            identity = target.identity(setup)
            found[entry.name] = None if identity is None else f"{found[entry.name]}, {identity}"
    return found


def short_reason(reason: str) -> str:
    """Why a metric has no value, for a table below a warning that has told how to mend it."""
    return next((word for word in MISSING if reason.startswith(word)), reason)
