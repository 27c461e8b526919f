"""Trainings to a size of the file: lambda follows the bytes on the way; quantiser steps or rows fill the last per cent.

Where the rate counts already, a larger lambda makes a smaller file within some hundred steps. So the estimated bytes
are led from where they are to the goal, along a curve that falls (or rises) by equal factors; no training begins anew.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

import torch
from sw_anchors.coded_anchors import CodedAnchors
from sw_anchors.noisy_values import Noise
from sw_gaussians.sized import LEAST_FILLED

from splatwizard_core.api import (
    Method,
    OptimizationParams,
    RenderResult,
    Scene,
    SplatModel,
    SplatOptimizer,
    TaskLog,
    UserInputError,
    parse_size,
)
from splatwizard_core.tooling import PlannedTask, filled_writer, load_plugins
from sw_compress.cutting import rows_by_worth, rows_that_fit, with_rows

logger = logging.getLogger(__name__)

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
HALVES = ("mlp_", "channel.", "context.network.", "context.slices.")
"""Beginnings of the names of weights that take two bytes in a file, or four."""
LARGER = 1.03
"""Share of the size that a training whose rows are cut at its end is led to."""
DRIFT = 0.993
"""Share of the size that its file may have before its last changes."""
HEADER = 200
"""Bytes that the header may grow by when the file is closed."""


@runtime_checkable
class Stepped(Protocol):
    """A model whose file has quantiser steps by group, multiplied by `led["steps"]`."""

    led: dict[str, Any]
    STEP_POWERS: tuple[float, ...]
    """By group, of the factor by which steps fill a size; 0: a network has learnt to read values of one step."""


def estimated_bytes(model: SplatModel, result: RenderResult | None = None) -> float | None:
    """Bytes of the attributes by the rate of training; None at a step that counts none.

    `extras["bits"]` of a render are the bits of a row, in the mean. Positions, masks and networks are not counted.
    """
    if isinstance(model, CodedAnchors):
        return anchor_bytes(model)
    bits = None if result is None else result.extras.get("bits")
    return None if bits is None else float(bits) * model.num_rows / 8


@torch.no_grad()
def anchor_bytes(model: CodedAnchors) -> float:
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
    """Schedule task that changes lambda so that the file comes to a size, and fills the size at its last step.

    size    as people write it
    method  name of the method, whose loss multiplies lambda by `factor`
    first   step from which the rate counts
    last    step that fills: the end of the training, or where a model that is not `Stepped` fixes its integers next
    raster  what the file asks of a renderer, for the worth of rows
    least   bytes that every file has, where they are known

    A model that is `Stepped` is filled by its quantiser steps, any other by its rows. Raises UserInputError for what is
    no size, and for one below `least`.
    """

    def __init__(
        self, size: str, method: str, first: int, last: int, *, raster: Mapping[str, Any] | None = None, least: int = 0
    ) -> None:
        self.size, self.method, self.last, self.raster = parse_size(size), method, last, dict(raster or {})
        self.asked = size
        self.begin = first + max(1, round(BEGIN * (last - first)))
        self.arrive, self.freeze = (max(self.begin + 1, round(share * last)) for share in (ARRIVE, FREEZE))
        self.every = max(1, (self.freeze - self.begin) // CHANGES)
        self.state: dict[str, float] = {}
        self.hold(least)

    def lead(self, stage: Any) -> None:
        """Join the plan of a stage, as its `leading`, by whose `factor` its loss multiplies lambda."""
        stage.leading = self
        stage.extra_tasks = (*stage.extra_tasks, PlannedTask(False, self.steps, self, name="lead lambda to the size"))

    @property
    def steps(self) -> list[int]:
        """Steps at which it runs."""
        return [1, *range(self.begin, self.freeze, self.every), self.last]

    @property
    def factor(self) -> float:
        """Factor of lambda now."""
        return self.state.get("factor", 1.0)

    def state_dict(self) -> dict[str, float]:
        """`factor` of lambda, `ratio` of real bytes to estimated ones, `began`: bytes at the first change."""
        return dict(self.state)

    def load_state_dict(self, state: dict[str, float]) -> None:
        self.state = dict(state)

    def hold(self, least: int) -> None:
        """Raise UserInputError if the networks alone are larger: at the start of a training, which would be in vain."""
        if least > self.size:
            raise UserInputError(
                f"--size {self.asked}: its networks alone have {least:,} bytes: ask for more, or make them smaller"
            )

    def __call__(
        self, model: SplatModel, opt: OptimizationParams, optimizer: SplatOptimizer, scene: Scene,
        result: RenderResult, step: int, log: TaskLog,
    ) -> None:  # fmt: skip
        if step == 1:
            weights = (p.numel() for name, p in model.named_parameters() if name.startswith(HALVES))
            self.hold(2 * sum(weights))
            return
        plugins = load_plugins()
        method: Method = plugins.methods.load(self.method)(plugins, opt)
        method.scene = scene

        def written(part: SplatModel = model) -> int:
            return len(filled_writer(method, part, self.raster, scene.origin)[0].to_bytes())

        if step < self.last:
            self.steer(model, written, step, log, result)
        elif isinstance(model, Stepped):
            self.fill(model, written, log)
        else:
            self.cut(method, model, optimizer, written, log)

    def steer(
        self, model: SplatModel, written: Callable[[], int], step: int, log: TaskLog, result: RenderResult | None = None
    ) -> None:
        """Change lambda by how far the file is from where it should be at this step.

        written     bytes of the file that the model would have now
        """
        state, estimate = self.state, estimated_bytes(model, result)
        if not estimate:
            return
        encodes = max(1, (self.freeze - self.begin) // (ENCODES * self.every)) * self.every
        due = "ratio" not in state or step - state.get("encoded", 0.0) >= encodes
        if due:
            state["ratio"], state["encoded"] = written() / estimate, float(step)
        now = state["ratio"] * estimate
        began = state.setdefault("began", now)
        way = min((step - self.begin) / (self.arrive - self.begin), 1.0)
        end = (GOAL if isinstance(model, Stepped) else LARGER) * self.size
        goal = began ** (1 - way) * end**way
        change = min(max(GAIN * math.log(now / goal), -MOST), MOST)
        state["factor"] = min(max(self.factor * math.exp(change), 1 / RANGE), RANGE)
        log.scalar("file bytes", now)
        log.scalar("lambda factor", state["factor"])

    def fill(self, model: Stepped, written: Callable[[], int], log: TaskLog) -> None:
        """Choose quantiser steps with which the file fills the size. Raises UserInputError that names the smallest."""

        def bytes_at(factor: float) -> int:
            model.led["steps"] = [factor**power for power in model.STEP_POWERS]
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
        self._tell(bytes_at(max(fitting, key=lambda each: each[1])[0]))
        log.scalar("factor of the quantiser steps", model.led["steps"][-1])

    def cut(
        self, method: Method, model: SplatModel, optimizer: SplatOptimizer, written: Callable[[SplatModel], int],
        log: TaskLog,
    ) -> None:  # fmt: skip
        """Remove the rows that training views miss least, so that the file fits. Raises UserInputError if none may."""
        size, whole = int(DRIFT * self.size) - HEADER, written(model)
        if whole <= size:
            self._tell(whole)
            return
        order = rows_by_worth(method, model, self.raster)
        count = rows_that_fit(model.num_rows, whole, size, lambda rows: written(with_rows(model, order(rows))))
        if not count:
            raise UserInputError(f"no file of {self.size:,} bytes was found: one row is too much")
        kept = torch.zeros(model.num_rows, dtype=torch.bool, device=model.device)
        kept[order(count)] = True
        log.say(f"removed {model.num_rows - count:,} of {model.num_rows:,} {model.ROW_LABEL} for --size {self.asked}")
        optimizer.keep_rows(model, kept)

    def _tell(self, found: int) -> None:
        """Say it where the file is too small, whatever lambda."""
        if found < LEAST_FILLED * self.size:
            logger.warning(
                "--size %s: the largest file of this training has %s bytes (lambda times %.3f): a higher --rate, or "
                "more start points, make larger ones", self.asked, f"{found:,}", self.factor,
            )  # fmt: skip


def _slope(a: tuple[float, int], b: tuple[float, int]) -> float:
    found = math.log(b[1] / a[1]) / math.log(b[0] / a[0])
    return min(max(found, SLOPES[0]), SLOPES[1])
