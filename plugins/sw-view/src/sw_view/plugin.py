"""Registers `sw render`, `sw bake`, `sw view` and the exporter of the one-file page.

It also shows trainings while they run, and leaves a page in run directories.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatwizard_core.api import Registry, hookimpl

if TYPE_CHECKING:
    from splatwizard_core.tooling import FinishedRuns, StartedTraining, TrainingObserver


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("render", "sw_view.render_command:render", position=4.5,
                 summary="draw an encoded scene: pictures, depth, normals")  # fmt: skip
    registry.add("bake", "sw_view.bake_command:bake", position=4.6,
                 summary="make explicit Gaussians of anchors, for viewers")  # fmt: skip
    registry.add("view", "sw_view.view_command:view", position=4.65, summary="look at decoded models in the browser")


@hookimpl
def register_exporters(registry: Registry) -> None:
    registry.add("html", "sw_view.page_file:export_page", suffix=".html",
                 summary="one page that shows the Gaussians in any browser, offline")  # fmt: skip


@hookimpl
def run_started(training: StartedTraining) -> TrainingObserver | None:
    if not training.log.view:
        return None
    from sw_view.live import LiveView

    return LiveView(training, training.log.view)


@hookimpl(tryfirst=True)  # the report has a link to what is written here
def run_finished(runs: FinishedRuns) -> None:
    if runs.complete:
        return
    from sw_view.after_run import show_finished

    for run in runs.runs:
        show_finished(run, runs.say)
