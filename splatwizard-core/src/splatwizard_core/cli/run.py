"""`sw run`: train, encode, decode, evaluate, report."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from splatwizard_core.cli import complete
from splatwizard_core.cli.options import (
    assignments,
    changed_plan_option,
    config_option,
    console,
    debug_option,
    device_option,
    images_option,
    init_option,
    json_option,
    lpips_option,
    options,
    preset_option,
    print_json,
    repeats_option,
    resume_option,
    scene_option,
    seed_option,
    set_option,
)
from splatwizard_core.cli.setup import (
    lpips_folder,
    method_names,
    open_session,
    output_folder,
    resolve_all,
    say,
    say_device,
)


@click.command(short_help="train, encode, decode, evaluate, report: one scene")
@options(
    click.option(
        "--method", "-m", "methods", multiple=True, metavar="NAME[,NAME]", shell_complete=complete.names("method"),
        help="One or more methods; repeatable.  [default: 3dgs, or what --config says]",
    ),
    scene_option, images_option,
    click.option(
        "--rate", "rates", metavar="NAME[,NAME]", shell_complete=complete.rates,
        help="Rate points: r1 (smallest file) .. rN, or low, default, high, all.  [default: default]",
    ),
    preset_option, init_option, config_option, set_option,
    click.option(
        "--out", default="out", show_default=True, metavar="DIR", shell_complete=complete.folders,
        help="Root of the run directories, DIR/<scene>/<method>/<rate>.",
    ),
    device_option, seed_option, lpips_option, repeats_option, resume_option, changed_plan_option, json_option,
    debug_option,
)  # fmt: skip
def run(
    methods: tuple[str, ...],
    scene: str | None,
    images: str | None,
    rates: str | None,
    preset: str | None,
    init: str | None,
    config_file: str | None,
    sets: tuple[str, ...],
    out: str,
    device: str | None,
    seed: int | None,
    lpips_weights: str | None,
    repeats: int,
    resume: bool,
    allow_changed_plan: bool,
    as_json: bool,
) -> None:
    """Train, encode, decode in a fresh process, evaluate, report: one scene, any methods and rate points.

    Finished steps are not done again; an interrupted run goes on from its last checkpoint. Several runs end in one
    table, one page and rd.svg, their rate-distortion curves, in the folder above theirs.
    """
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.runs.directory import RunRequest
    from splatwizard_core.runs.observers import FinishedRun, FinishedRuns
    from splatwizard_core.runs.run import run as run_one

    plugins = load_plugins()
    values = assignments(sets, images=images, device=device, seed=seed, init=init)
    weights = lpips_folder(lpips_weights)
    if weights is not None:
        values["metrics.lpips.weights"] = str(weights)
    resolved = resolve_all(
        plugins, method_names(methods, config_file), rates,
        preset=preset, config_file=config_file, values=values, scene=scene,
    )  # fmt: skip
    output_folder(out)
    session = open_session(resolved[0].ppl, plugins)
    for each in resolved:
        session.scene(each)  # what is wrong with it is told before anything else is said
    say_device(resolved[0].ppl, session)
    if any(r.preset == "quick" and r.procedural for r in resolved) and preset is None:
        say("preset quick: the plan scaled down for the demo scene (--preset paper runs it in full)")
    finished: list[FinishedRun] = []
    written: list[Path] = []
    out_console = None if as_json else console()
    for each in resolved:
        request = RunRequest(
            each, Path(out), resume=resume, allow_changed_plan=allow_changed_plan, repeats=repeats,
        )  # fmt: skip
        record, directory = run_one(session, request)
        finished.append(FinishedRun(directory, record, partial(session.scene, each)))
        plugins.hook.run_finished(runs=FinishedRuns(finished[-1:], False, out_console, say, written))
    if len(finished) > 1:
        written.clear()  # the pages of single runs lie beside their records
    plugins.hook.run_finished(runs=FinishedRuns(finished, True, out_console, say, written))
    if as_json:
        runs = [{"directory": str(f.directory), "record": f.record.model_dump(mode="json")} for f in finished]
        print_json({"runs": runs, "written": [str(path) for path in written]})
