"""Trainings to a size of the file: lambda follows the bytes on the way, quantiser steps fill the last per cent.

Where the rate counts already, a larger lambda makes a smaller file within some hundred steps. So the estimated bytes
are led from where they are to the goal, along a curve that falls (or rises) by equal factors; no training begins anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from sw_anchors.coded_anchors import CodedAnchors
from sw_anchors.noisy_values import Noise
from sw_gaussians.byte_sizes import parse_size

from splatwizard_core.api import ContainerWriter, Method, OptimizationParams, TaskLog, UserInputError
from splatwizard_core.tooling import load_plugins

GOAL = 0.98
"""Share of the size that a training is led to."""
BEGIN, ARRIVE, FREEZE = 0.05, 0.7, 0.85
"""Share of the steps with a rate before lambda changes; shares of all steps at the goal, and at the last change."""
CHANGES = 120
"""Changes of lambda in a training; the published plans have one every hundred steps."""
GAIN, MOST = 0.4, 0.1
"""Change of log lambda by the error of the log bytes: 0.1 over the power by which bytes fall, 0.17 to 0.38; at most."""
RANGE = 16.0
"""Factor that lambda is multiplied or divided by at most."""
ENCODES = 5
"""Real files on the way, which tell by how much the estimate is off."""
SAMPLE = 20_000
"""Anchors that the bytes are estimated from."""
FILLED = 0.985
"""Share of the size that the last choice aims at, and which is good enough where steps are as trained."""
LEAST, MOST_STEP = 0.5, 8.0
"""Bounds of the factor on the quantiser steps."""
SLOPE, SLOPES = -0.5, (-2.0, -0.02)
"""Power of the factor that bytes fall with, before two files tell it; bounds."""
TRIES = 8
HEADER = 1_000
"""Bytes that the header may grow by when the file is closed: what a reader needs."""


@torch.no_grad()
def estimated_bytes(model: CodedAnchors) -> float:
    """Bytes of the attributes by the rate model, without noise; positions, masks and networks are not counted."""
    kept = torch.nonzero(model.kept()).squeeze(1)
    rows = kept[:: max(1, len(kept) // SAMPLE)]
    if not len(rows):
        return 0.0
    every = torch.arange(len(rows), device=rows.device)
    forecast = model.rate_model.forecast(model.context_of(rows), every)
    middle = model.features.new_full((len(rows), sum(model.shape.widths)), 0.5)  # no noise
    values = model.noisy(rows, Noise(forecast.sample_steps, middle), every)
    bits, _ = model.rate_model.rate(values.sample, forecast, values.masks, values.sample.new_ones(len(rows)))
    own = 0.0 if forecast.own_bits is None else float(forecast.own_bits)
    return (float(bits) * len(kept) / len(rows) + own) / 8


class LeadToSize:
    """Schedule task that changes lambda so that the file comes to a size, and in the last step the quantiser steps.

    size    as people write it
    method  name of the method: one whose model is a CodedAnchors, and whose lambda and steps follow its `led`
    first   step from which the rate counts
    last    step of the training

    State is in `model.led`: `factor` of lambda, `ratio` of real bytes to estimated ones, `began`: bytes at the first
    change, `steps`: factors of the quantiser steps by group. Raises UserInputError for what is no size.
    """

    def __init__(self, size: str, method: str, first: int, last: int) -> None:
        self.size, self.method, self.last = parse_size(size), method, last
        self.begin = first + max(1, round(BEGIN * (last - first)))
        self.arrive, self.freeze = (max(self.begin + 1, round(share * last)) for share in (ARRIVE, FREEZE))
        self.every = max(1, (self.freeze - self.begin) // CHANGES)

    @property
    def steps(self) -> list[int]:
        """Steps at which it runs."""
        return [*range(self.begin, self.freeze, self.every), self.last]

    def __call__(self, model: CodedAnchors, opt: OptimizationParams, step: int, log: TaskLog) -> None:
        plugins = load_plugins()
        method = plugins.methods.load(self.method)(plugins, opt)
        if step < self.last:
            self.steer(model, lambda: written_bytes(method, model), step, log)
        else:
            self.fill(model, lambda: written_bytes(method, model), log)

    def steer(self, model: CodedAnchors, written: Callable[[], int], step: int, log: TaskLog) -> None:
        """Change lambda by how far the file is from where it should be at this step.

        written     bytes of the file that the model would have now
        """
        state, estimate = model.led, max(estimated_bytes(model), 1.0)
        encodes = max(1, (self.freeze - self.begin) // (ENCODES * self.every)) * self.every
        if "ratio" not in state or (step - self.begin) % encodes == 0:
            state["ratio"] = written() / estimate
        now = state["ratio"] * estimate
        began = state.setdefault("began", now)
        way = min((step - self.begin) / (self.arrive - self.begin), 1.0)
        goal = began ** (1 - way) * (GOAL * self.size) ** way
        change = min(max(GAIN * math.log(now / goal), -MOST), MOST)
        state["factor"] = min(max(state.get("factor", 1.0) * math.exp(change), 1 / RANGE), RANGE)
        log.scalar("file bytes", now)
        log.scalar("lambda factor", state["factor"])

    def fill(self, model: CodedAnchors, written: Callable[[], int], log: TaskLog) -> None:
        """Choose quantiser steps with which the file fills the size. Raises UserInputError that names the smallest."""
        # A network has learnt to read features in the step that they have: where there is one, it stays.
        group = (0.0, 1.0, 1.0) if getattr(model, "channel", None) is not None else (1.0, 1.0, 1.0)

        def bytes_at(factor: float) -> int:
            model.led["steps"] = [factor**power for power in group]
            return written() + HEADER

        known = [(1.0, bytes_at(1.0))]
        goal = (FILLED + 1) / 2 * self.size
        while len(known) < TRIES and not FILLED * self.size <= known[-1][1] <= self.size:
            over, under = ([each for each in known if (each[1] > self.size) == above] for above in (True, False))
            if over and under:  # between the nearest of both
                (a, high), (b, low) = max(over), min(under)
                share = math.log(high / goal) / math.log(high / low)
                found = a * (b / a) ** min(max(share, 0.1), 0.9)
            else:
                before, size_then = known[-1]
                power = SLOPE if len(known) == 1 else _slope(known[-2], known[-1])
                found = min(max(before * (goal / size_then) ** (1 / power), LEAST), MOST_STEP)
            if any(found == factor for factor, _ in known):
                break
            known.append((found, bytes_at(found)))
        fitting = [each for each in known if each[1] <= self.size]
        if not fitting:
            raise UserInputError(
                f"no file of {self.size:,} bytes was found: the smallest of this training has "
                f"{min(size for _, size in known):,}"
            )
        bytes_at(max(fitting, key=lambda each: each[1])[0])
        log.scalar("factor of the quantiser steps", model.led["steps"][1])


def written_bytes(method: Method, model: CodedAnchors) -> int:
    """Bytes of the file that a model would have now, but for what its header says of packages."""
    writer = ContainerWriter(method.name, method.version)
    with torch.no_grad():
        method.encode(model, writer)
    return len(writer.to_bytes())


def _slope(a: tuple[float, int], b: tuple[float, int]) -> float:
    found = math.log(b[1] / a[1]) / math.log(b[0] / a[0])
    return min(max(found, SLOPES[0]), SLOPES[1])
