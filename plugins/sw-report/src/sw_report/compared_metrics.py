"""Registered metrics of pictures, of B's against A's: the ones that `sw eval` measures against photographs."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import CapabilityError, MetricSetup, PluginError, PreparedMetric, UserInputError
from splatwizard_core.tooling import Entry, MetricInfo, PluginManager


class PictureMetrics:
    """Measures pictures while they come: `add` each pair, then `result`. Raises UserInputError for names of no such.

    settings    of the metrics, by group, as of --set metrics.GROUP.KEY
    """

    def __init__(
        self, names: Sequence[str], plugins: PluginManager, device: torch.device, settings: dict[str, dict[str, Any]]
    ) -> None:
        self._entries: list[Entry] = [plugins.metrics.entry(name) for name in dict.fromkeys(names)]
        if others := [e.name for e in self._entries if MetricInfo.of(e).over != "image"]:
            raise UserInputError(f"--metrics {others[0]}: it is not of pictures")
        setup = MetricSetup(device, settings)
        self._ready: dict[str, PreparedMetric] = {}
        self._reasons: dict[str, str] = {}
        self._values: dict[str, list[float]] = {entry.name: [] for entry in self._entries}
        for entry in self._entries:
            try:
                target: Any = entry.load()
                ready = target.prepare(setup) if hasattr(target, "prepare") else PreparedMetric(target)
                self._ready[entry.name] = ready
            except (CapabilityError, PluginError) as error:
                self._reasons[entry.name] = str(error)

    def add(self, reference: Tensor, render: Tensor) -> None:
        """Take the next picture of A and of B, [3,H,W] in 0..1; they are rounded to 8 bit."""
        truth, test = (torch.round(each.clamp(0, 1) * 255) / 255 for each in (reference, render))
        for name, metric in self._ready.items():
            if name not in self._reasons:
                try:
                    self._values[name].append(float(metric.compute(test, truth)))
                except CapabilityError as error:
                    self._reasons[name] = str(error)

    def result(self) -> dict[str, dict[str, Any]]:
        """Return of each metric its mean, direction and what it was made with, or None and the reason."""
        found: dict[str, dict[str, Any]] = {}
        for entry in self._entries:
            reason = self._reasons.get(entry.name)
            values = [] if reason is not None else self._values[entry.name]
            found[entry.name] = {"mean": statistics.fmean(values) if values else None, "per_view": values,
                                 "direction": MetricInfo.of(entry).direction}  # fmt: skip
            if reason is not None:
                found[entry.name]["reason"] = reason
            elif made := dict(self._ready[entry.name].made_with):
                found[entry.name]["made_with"] = made
        return found
