"""Registers the command `sw bench` and the executors `local`, `slurm` and `ray`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from splatwizard_core.api import Registry, hookimpl

if TYPE_CHECKING:
    from splatwizard_core.tooling import StartedTraining, TrainingObserver


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("bench", "sw_bench.command:bench", position=0.5,
                 summary="methods x scenes x rates x seeds: a sweep that goes on after any kill")  # fmt: skip


@hookimpl
def register_executors(registry: Registry) -> None:
    registry.add("local", "sw_bench.local:LocalExecutor",
                 summary="processes on this machine: one per GPU, or a share of the cores each")  # fmt: skip
    registry.add("slurm", "sw_bench.slurm:SlurmExecutor",
                 summary="jobs of a Slurm cluster, through submitit")  # fmt: skip
    registry.add("ray", "sw_bench.ray_cluster:RayExecutor", summary="tasks of a Ray cluster")


@hookimpl
def run_started(training: StartedTraining) -> TrainingObserver | None:
    # Whoever probes has imported the module; every other command is spared it.
    probe = sys.modules.get("sw_bench.probe")
    clock = None if probe is None else probe.Clock.current
    found: TrainingObserver | None = clock if clock is not None and clock.method == training.method else None
    return found
