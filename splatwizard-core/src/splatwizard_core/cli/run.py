"""`sw run`: train, encode, decode, evaluate, report."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from splatwizard_core.cli import complete
from splatwizard_core.cli.options import (
    assignments,
    changed_plan_option,
    config_option,
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
from splatwizard_core.cli.results import print_results
from splatwizard_core.cli.setup import (
    lpips_folder,
    method_names,
    open_session,
    output_folder,
    resolve_all,
    say,
    say_device,
)

if TYPE_CHECKING:
    from splatwizard_core.experiments.record import Record
    from splatwizard_core.scene.scene import Scene


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
    from splatwizard_core.experiments.config import is_demo
    from splatwizard_core.experiments.run import RunRequest
    from splatwizard_core.experiments.run import run as run_one
    from splatwizard_core.plugins import load_plugins

    plugins = load_plugins()
    values = assignments(sets, images=images, device=device, seed=seed, init=init)
    resolved = resolve_all(
        plugins, method_names(methods, config_file), rates,
        preset=preset, config_file=config_file, values=values, scene=scene,
    )  # fmt: skip
    output_folder(out)
    session = open_session(resolved[0].ppl, plugins)
    for each in resolved:
        session.scene(each)  # what is wrong with it is told before anything else is said
    weights = lpips_folder(lpips_weights)
    say_device(resolved[0].ppl, session)
    if any(r.preset == "quick" and is_demo(r.scene_spec) for r in resolved) and preset is None:
        say("preset quick: the plan scaled down for the demo scene (--preset paper runs it in full)")
    done: list[tuple[Record, Path]] = []
    pages: list[Path] = []
    for each in resolved:
        request = RunRequest(
            each, Path(out), resume=resume, allow_changed_plan=allow_changed_plan, lpips_weights=weights,
            repeats=repeats,
        )  # fmt: skip
        done.append(run_one(session, request))
        pages += page_of_run(done[-1][1], partial(session.scene, each))
    above = above_runs([directory for _, directory in done])
    if as_json:
        runs = [{"directory": str(d), "record": r.model_dump(mode="json")} for r, d in done]
        print_json({"runs": runs, "written": [str(path) for path in above]})
    else:
        print_results(done, above or pages)


def page_of_run(directory: Path, open_scene: Callable[[], Scene]) -> list[Path]:
    """report.html of a run directory; without jinja2 a line says what to install."""
    try:
        from splatwizard_core.experiments.report.after_run import report_run
    except ModuleNotFoundError as error:
        if error.name not in ("jinja2", "markupsafe"):
            raise
        say("no report.html: it needs jinja2 (pip install 'splatwizard-core[report]')")
        return []
    page = report_run(directory, open_scene, say)
    return [] if page is None else [page]


def above_runs(directories: list[Path]) -> list[Path]:
    """What is about all that one command ran, in the folder above: the page, and rate and distortion as a file."""
    try:
        from splatwizard_core.experiments.report.after_run import plot_above, report_above
    except ModuleNotFoundError:
        return []  # told already
    found = [report_above(directories, say), plot_above(directories, say)]
    return [path for path in found if path is not None]
