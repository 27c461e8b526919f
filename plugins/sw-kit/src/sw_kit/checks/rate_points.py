"""The check of a method's rate points: r1 is the smallest file, rN the largest."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from splatwizard_core.api import ContainerWriter
from splatwizard_core.tooling import RunRequest, Session, directory_lock, train_in
from sw_kit.checks.small_run import CPU, small_configuration
from sw_kit.finding import hold

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager
    from splatwizard_core.tooling import Entry

log = logging.getLogger(__name__)

STEPS = 20
SLACK = 1.05
"""After so few steps a rate term has hardly worked, so two points of it differ by chance."""


def check_rate_points(entry: Entry, plugins: PluginManager, settings: Sequence[str] = ()) -> str:
    """Hold the files of the first and the last rate point, each trained for 20 steps, to be in order of size."""
    rates = list(entry.load().RATES)
    if len(rates) < 2:
        return "one rate point, nothing to compare"
    first, last = rates[0], rates[-1]
    small, large = (_size(entry, plugins, settings, rate) for rate in (first, last))
    hold(
        small <= SLACK * large,
        f"the file of {first} has {small:,} bytes, that of {last} {large:,}",
        f"RATES go from the smallest file to the largest: name them the other way round ({first} is `low`)",
    )
    return f"{first} {small:,} bytes, {last} {large:,} bytes"


def _size(entry: Entry, plugins: PluginManager, settings: Sequence[str], rate: str) -> int:
    """Bytes of the file of a short training at a rate point."""
    resolved = small_configuration(entry, plugins, settings, rate, STEPS)
    method = entry.load()(plugins, resolved.config)
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "demo-tiny" / resolved.method / resolved.rate
        with directory_lock(directory):
            found = train_in(Session(plugins, CPU, log.debug), RunRequest(resolved, Path(folder)), directory)
        writer = ContainerWriter(method.name, method.version)
        with torch.no_grad():
            method.encode(found.model, writer)
    return len(writer.to_bytes())
