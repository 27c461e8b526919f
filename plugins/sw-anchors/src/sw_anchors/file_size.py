"""Trainings to a size of the file: lambda follows the bytes on the way, quantiser steps fill the last per cent.

Where the rate counts already, a larger lambda makes a smaller file within some hundred steps. So the estimated bytes
are led from where they are to the goal, along a curve that falls (or rises) by equal factors; no training begins anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from sw_gaussians.byte_sizes import parse_size

from splatwizard_core.api import ContainerWriter, TaskLog, UserInputError
from sw_anchors.coded_anchors import CodedAnchors
from sw_anchors.noisy_values import Noise

if TYPE_CHECKING:
    from splatwizard_core.api import Scheduler

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


class SizeControl:
    """Schedule tasks that change lambda so that the file comes to a size.

    size        bytes
    file_bytes  of the file that a model would have now
    first       step from which the rate counts
    steps       of the whole training

    State is in `model.size_control`: `factor` multiplies lambda, `ratio` is real bytes over estimated ones, `began`
    those at the first change.
    """

    def __init__(self, size: str, file_bytes: Callable[[CodedAnchors], int], *, first: int, steps: int) -> None:
        self.size, self._file_bytes = parse_size(size), file_bytes
        self.begin = first + max(1, round(BEGIN * (steps - first)))
        self.arrive, self.freeze = (max(self.begin + 1, round(share * steps)) for share in (ARRIVE, FREEZE))
        self.every = max(1, (self.freeze - self.begin) // CHANGES)

    def register(self, scheduler: Scheduler) -> None:
        scheduler.register_task(range(self.begin, self.freeze, self.every), self.steer, name="lead lambda to the size")

    def steer(self, model: CodedAnchors, step: int, log: TaskLog) -> None:
        """Change lambda by how far the file is from where it should be at this step."""
        state, estimate = model.size_control, max(estimated_bytes(model), 1.0)
        encodes = max(1, (self.freeze - self.begin) // (ENCODES * self.every)) * self.every
        if "ratio" not in state or (step - self.begin) % encodes == 0:
            state["ratio"] = self._file_bytes(model) / estimate
        now = state["ratio"] * estimate
        began = state.setdefault("began", now)
        way = min((step - self.begin) / (self.arrive - self.begin), 1.0)
        goal = began ** (1 - way) * (GOAL * self.size) ** way
        change = min(max(GAIN * math.log(now / goal), -MOST), MOST)
        state["factor"] = min(max(state.get("factor", 1.0) * math.exp(change), 1 / RANGE), RANGE)
        log.scalar("file bytes", now)
        log.scalar("lambda factor", state["factor"])


def filling_factor(write: Callable[[ContainerWriter, float], None], like: ContainerWriter, size: str) -> float:
    """Return the factor on the quantiser steps with which a file fills `size`, or 1 for an empty one.

    write   writes the sections with such a factor
    like    writer of the file, which stays as it is

    Raises UserInputError that names the smallest file there is.
    """
    if not size:
        return 1.0
    limit = parse_size(size)

    def written(factor: float) -> int:
        writer = ContainerWriter(like.method, like.version, raster=like.raster)
        write(writer, factor)
        return len(writer.to_bytes()) + HEADER

    known = [(1.0, written(1.0))]
    goal = (FILLED + 1) / 2 * limit
    while len(known) < TRIES and not FILLED * limit <= known[-1][1] <= limit:
        over, under = ([each for each in known if (each[1] > limit) == above] for above in (True, False))
        if over and under:  # between the nearest of both
            (a, high), (b, low) = max(over), min(under)
            share = math.log(high / goal) / math.log(high / low)
            found = a * (b / a) ** min(max(share, 0.1), 0.9)
        else:
            last, size_then = known[-1]
            power = SLOPE if len(known) == 1 else _slope(known[-2], known[-1])
            found = min(max(last * (goal / size_then) ** (1 / power), LEAST), MOST_STEP)
        if any(found == factor for factor, _ in known):
            break
        known.append((found, written(found)))
    fitting = [each for each in known if each[1] <= limit]
    if not fitting:
        raise UserInputError(
            f"no file of {limit:,} bytes was found: the smallest of this training has {min(n for _, n in known):,}"
        )
    return max(fitting, key=lambda each: each[1])[0]


def _slope(a: tuple[float, int], b: tuple[float, int]) -> float:
    found = math.log(b[1] / a[1]) / math.log(b[0] / a[0])
    return min(max(found, SLOPES[0]), SLOPES[1])
