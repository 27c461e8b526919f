"""Shares of a profiled training step: time, operators, kernels and waits of each part, and the longest kernels."""

from __future__ import annotations

import collections
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

SECTION = "section: "
WAITS_ON_CUDA = ("cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize")
WAITS = ("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::_unique2", "aten::unique_dim")
"""Operators that make the host wait for a GPU; what they stand in (item, indexing by a mask) ends in one of them."""

PRODUCTS = ("aten::addmm", "aten::mm", "aten::linear", "aten::threshold_backward", "aten::relu_")
"""Operators of the MLPs that decode Gaussians, which run within the node of `network_outputs`."""


@dataclass
class Part:
    """Time of one part of a step, summed over the window; times in microseconds."""

    host: float = 0.0
    device: float = 0.0
    operators: int = 0
    kernels: int = 0
    waits: int = 0


def report(watched: Any, steps: int, *, cuda: bool, rows: int) -> list[str]:
    """The table of parts."""
    events = sorted(watched.events(), key=lambda e: e.time_range.start)
    part_of, forward = _sections(events)
    parts: dict[str, Part] = collections.defaultdict(Part)
    for event in events:
        if str(event.device_type).endswith("CUDA"):
            continue
        name = part_of(event, forward)
        if name == "decoding" and _within(event, PRODUCTS):
            name = "anchor MLPs"
        part = parts[name]
        part.host += event.self_cpu_time_total
        part.operators += event.name.startswith("aten::") and not _inside_operator(event)
        part.waits += event.name in (WAITS_ON_CUDA if cuda else WAITS)
        kernels = [k for k in event.kernels if not k.name.startswith(SECTION)]
        part.kernels += len(kernels)
        part.device += sum(k.duration for k in kernels)
    total = Part(*(sum(getattr(p, name) for p in parts.values()) for name in Part.__dataclass_fields__))
    head = f"{rows:,} anchors, a step:"
    lines = [f"      {head:34} {'host':>6} {'GPU':>6} {'ops':>6} {'kernels':>8} {'waits':>6}"]
    ordered = sorted(parts.items(), key=lambda item: -item[1].host)
    for name, p in [*ordered, ("all", total)]:
        host, device = (_share(getattr(p, which), getattr(total, which)) for which in ("host", "device"))
        counts = f"{p.operators / steps:6.1f} {p.kernels / steps:8.1f} {p.waits / steps:6.1f}"
        lines.append(f"        {name:32} {host:>6} {device:>6} {counts}")
    lines.append(
        f"        all, ms                          {total.host / steps / 1e3:6.2f} {total.device / steps / 1e3:6.2f}"
    )
    return lines


def kernel_times(watched: Any) -> dict[str, tuple[float, int]]:
    """Milliseconds and launches of each kernel and copy of a GPU; those of graphs included, which belong to no part."""
    found: dict[str, tuple[float, int]] = {}
    for event in watched.events():
        if str(event.device_type).endswith("CUDA") and not event.name.startswith(SECTION):
            total, count = found.get(event.name, (0.0, 0))
            found[event.name] = total + event.time_range.elapsed_us() / 1e3, count + 1
    return found


def longest_kernels(watched: Any, steps: int, most: int) -> list[str]:
    """The kernels that take the most time of a step."""
    ordered = sorted(kernel_times(watched).items(), key=lambda item: -item[1][0])[:most]
    return [f"      {t / steps:7.3f} ms {n / steps:6.1f} x {name[:150]}" for name, (t, n) in ordered]


def _share(value: float, total: float) -> str:
    return f"{value / total:.1%}" if total else "-"


def _sections(events: list[Any]) -> tuple[Callable[[Any, dict[int, str]], str], dict[int, str]]:
    """Find an event's part, and the part of each autograd node by its sequence number."""

    def part_of(event: Any, forward: dict[int, str]) -> str:
        while event is not None:
            if event.name.startswith(SECTION):
                return str(event.name[len(SECTION) :])
            if event.name.startswith("autograd::engine::evaluate_function"):
                return forward.get(event.sequence_nr, "rest")
            event = event.cpu_parent
        return "rest"

    forward: dict[int, str] = {}
    for event in events:
        inside: Any = event
        while inside is not None and not inside.name.startswith("autograd::engine"):
            inside = inside.cpu_parent
        if event.sequence_nr >= 0 and inside is None:
            # Operators that make no node carry the number of the next one that does: the last to have it made it.
            forward[event.sequence_nr] = part_of(event, {})
    return part_of, forward


def _within(event: Any, names: tuple[str, ...]) -> bool:
    while event is not None and event.name not in names:
        event = event.cpu_parent
    return event is not None


def _inside_operator(event: Any) -> bool:
    parent = event.cpu_parent
    while parent is not None:
        if parent.name.startswith("aten::"):
            return True
        parent = parent.cpu_parent
    return False
