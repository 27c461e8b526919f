"""Registers `sw report`, `sw compare`, `sw info`; makes what `sw run` ends with; logs to TensorBoard."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatwizard_core.api import Registry, hookimpl

if TYPE_CHECKING:
    from splatwizard_core.tooling import FinishedRuns, StartedTraining, TrainingObserver


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("report", "sw_report.command:report", position=4.7, summary="tables, curves, BD-rates, one HTML page")
    registry.add(
        "compare", "sw_report.compare:compare", position=4.8, summary="two files; a run beside published figures"
    )
    registry.add("info", "sw_report.info:info", position=5.5, summary="what is in a file or scene")


@hookimpl
def run_started(training: StartedTraining) -> TrainingObserver | None:
    if not training.log.tensorboard:
        return None
    from sw_report.tensorboard_log import TensorBoardLog

    return TensorBoardLog(training.directory / "tensorboard")


@hookimpl
def run_finished(runs: FinishedRuns) -> None:
    # Imported here: every `sw` command loads this module.
    from sw_report.after_run import report_finished

    report_finished(runs)
