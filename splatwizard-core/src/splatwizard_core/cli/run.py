"""`sw run`: train, encode, decode, evaluate, report."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from splatwizard_core.cli import options as shared
from splatwizard_core.cli.setup import Choices, open_training_session, takes_choices, warn_of_metrics
from splatwizard_core.plugins import load_plugins

if TYPE_CHECKING:
    from splatwizard_core.plugins import PluginManager
    from splatwizard_core.runs.observers import FinishedRun


@click.command(short_help="train, encode, decode, evaluate, report: one scene")
@shared.options(
    shared.methods_option, shared.scene_option, shared.images_option, shared.rates_option, shared.preset_option,
    shared.size_options, shared.init_option, shared.config_option, shared.set_option, shared.out_option,
    shared.device_option, shared.seeds_option, shared.repeats_option, shared.geometry_option, shared.resume_option,
    shared.changed_plan_option, shared.json_option, shared.debug_option,
)  # fmt: skip
@takes_choices
def run(
    out: Path, repeats: int, geometry: bool, resume: bool, allow_changed_plan: bool, as_json: bool, chosen: Choices
) -> None:
    """Train, encode, decode in a fresh process, evaluate, report: one scene, any methods and rate points.

    Finished steps are not done again; an interrupted run goes on from its last checkpoint. Installed packages make
    tables and pages of the finished runs; those about several runs go into the folder above theirs. Comma lists of
    scenes or seeds make a sweep.
    """
    from splatwizard_core.runs.directory import RunRequest
    from splatwizard_core.runs.observers import FinishedRun, FinishedRuns
    from splatwizard_core.runs.run import run as run_one

    plugins = load_plugins()
    if isinstance(chosen.seed, tuple) or ("," in (chosen.scene or "") and not Path(str(chosen.scene)).exists()):
        context = click.get_current_context()
        context.exit(context.invoke(plugins.commands.load("bench"), **context.params))  # sweeps are another package's
    resolved, session = open_training_session(chosen, plugins)
    warn_of_metrics(session, None, resolved[0].metrics, geometry=geometry)
    if chosen.preset is None and any(each.preset == "quick" and each.procedural for each in resolved):
        shared.say("preset quick: the plan scaled down for a procedural scene (--preset paper runs it in full)")
    finished: list[FinishedRun] = []
    written: list[Path] = []
    console = None if as_json else shared.console()
    for each in resolved:
        request = RunRequest(each, out, resume, allow_changed_plan, repeats, geometry)
        record, directory = run_one(session, request)
        finished.append(FinishedRun(directory, record, partial(session.scene, each)))
        plugins.hook.run_finished(runs=FinishedRuns(finished[-1:], False, console, shared.say, written))
    of_single_runs = set(written)
    plugins.hook.run_finished(runs=FinishedRuns(finished, True, console, shared.say, written))
    if as_json:
        runs = [{"directory": str(f.directory), "record": f.record.model_dump(mode="json")} for f in finished]
        shared.print_json({"runs": runs, "written": [str(path) for path in written if path not in of_single_runs]})
    elif not getattr(console, "printed", False):
        for line in [*(summary(each, plugins) for each in finished), *map(str, written)]:
            click.echo(line)


def summary(finished: FinishedRun, plugins: PluginManager) -> str:
    """One line about a finished run, for where no package prints a table."""
    from splatwizard_core.evaluation.metrics import MetricInfo

    record = finished.record
    scores = []
    for entry in plugins.metrics:
        info, metric = MetricInfo.of(entry), record.metrics.get(entry.name)
        if metric is not None and metric.mean is not None and not metric.diagnostic:
            scores.append(f"{info.label} {metric.mean:.{info.digits}f} {info.unit}".rstrip())
    name = f"{record.method} {record.rate}: "
    return name + ", ".join([*scores, f"{record.file.bytes:,} bytes"]) + f": {finished.directory}"
