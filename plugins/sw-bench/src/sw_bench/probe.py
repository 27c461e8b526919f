"""A short measured probe: a few training steps of each method, for an estimate before a sweep."""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatwizard_core.api import SplatwizardError
from splatwizard_core.tooling import (
    PluginManager,
    ResolvedConfig,
    RunRequest,
    Session,
    choose_device,
    load_plugins,
    make_method,
    named_scenes,
    run_directory,
    say,
    train_in,
)
from sw_bench.cells import Job
from sw_bench.estimates import Estimates

log = logging.getLogger(__name__)
STEPS = 16  # measured, after the first, which warms up
BASE_STEPS = 20  # of the trained scenes that a method starts from: the probe does not wait for real ones


class Clock:
    """Times of the steps of a training, as its observer."""

    current: Clock | None = None
    """Observes the training that a probe has begun; None: no probe is going on."""

    def __init__(self, method: str) -> None:
        self.method = method
        self.times: list[float] = []

    def after_step(self, model: Any, record: Any) -> None:
        """Note the time."""
        self.times.append(time.perf_counter())

    def finished(self) -> None:
        """Nothing is left to do."""

    @property
    def step_seconds(self) -> float | None:
        """Mean seconds of a step, without the first; None where fewer than two were seen."""
        count = len(self.times) - 1
        return (self.times[-1] - self.times[0]) / count if count > 0 else None


def probe_into(estimates: Estimates, jobs: Sequence[Job]) -> None:
    """Measure each method on its first scene, and the first one on every scene; tell the estimates.

    What is known from finished runs is not measured. A probe that fails is said, and leaves its estimate unknown.
    """
    plugins = load_plugins()
    chosen: dict[tuple[str, str], Job] = {}
    for job in jobs:
        label, scene = job.about
        if not job.trains:
            estimates.learn(label, scene, 0.0)
            continue
        is_first_of_method = all(known != label for known, _ in chosen)
        is_first_of_scene = all(known != scene for _, known in chosen)
        if (is_first_of_method or is_first_of_scene) and not estimates.knows(label, scene):
            chosen[job.about] = job
    for about, job in chosen.items():
        resolved = job.cells[0].resolved if job.shared is None else job.shared.resolved
        try:
            seconds, told = probe(resolved, plugins)
        except SplatwizardError as error:
            say(f"no estimate of {' on '.join(about)}: {error}")
            continue
        say(f"{' on '.join(about)}: {told}")
        estimates.learn(*about, seconds)


def probe(resolved: ResolvedConfig, plugins: PluginManager) -> tuple[float, str]:
    """Return the seconds that a training will take by its first steps, and a line about them.

    The model is as small as at the start, and a scene that it starts from is trained for a few steps alone: a lower
    bound, as models grow.
    """
    method = make_method(plugins, resolved)
    total = sum(stage.iterations for stage in method.stages())
    if not resolved.init and named_scenes(method):
        resolved = replace(resolved, pretrained={**resolved.pretrained, "iterations": BASE_STEPS})
    session = Session(plugins, choose_device(resolved.ppl.device, plugins), log.debug)
    Clock.current = clock = Clock(resolved.method)
    try:
        with tempfile.TemporaryDirectory() as folder:
            request = RunRequest(resolved, Path(folder))
            directory = run_directory(request)
            directory.mkdir(parents=True)
            train_in(session, request, directory, stop_after=STEPS + 1)
    except KeyboardInterrupt:
        if len(clock.times) <= STEPS:  # the user's own
            raise
    finally:
        Clock.current = None
    if total == 0 or clock.step_seconds is None:
        return 0.0, "no training steps"
    return clock.step_seconds * total, f"{total:,} steps of {clock.step_seconds * 1000:.1f} ms"
