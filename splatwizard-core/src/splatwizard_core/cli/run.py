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

if TYPE_CHECKING:
    from splatwizard_core.experiments.record import Record
    from splatwizard_core.scene.scene import Scene

FIRST = ("psnr", "ssim", "lpips_vgg_3dgs", "l1")
"""Metrics that stand first in the table, in this order."""


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

    Finished steps are not done again; an interrupted run goes on from its last checkpoint.
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
    pages += page_above([directory for _, directory in done])
    if as_json:
        print_json({"runs": [{"directory": str(d), "record": r.model_dump(mode="json")} for r, d in done]})
    else:
        from rich.markup import escape

        print_results(done)
        for page in pages:
            console().print(escape(str(page)), soft_wrap=True)


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


def page_above(directories: list[Path]) -> list[Path]:
    """The page about all that one command ran, in the folder above; the broadest of all."""
    try:
        from splatwizard_core.experiments.report.after_run import report_above
    except ModuleNotFoundError:
        return []  # told already
    page = report_above(directories, say)
    return [] if page is None else [page]


def print_results(done: list[tuple[Record, Path]]) -> None:
    """One row a run, on stdout."""
    from rich.markup import escape
    from rich.table import Table

    out = console()
    first = done[0][0]
    # A metric that nobody could compute has its reason below, and no column.
    names = list(dict.fromkeys(
        name for record, _ in done for name, metric in record.metrics.items()
        if not metric.diagnostic and (metric.mean is not None or metric.per_view)
    ))  # fmt: skip
    names.sort(key=lambda n: (FIRST.index(n) if n in FIRST else len(FIRST), n))
    table = Table(
        title=f"{escape(first.scene)}: {first.test_views} test views, protocol {escape(first.protocol.id)}",
        title_justify="left",
    )
    table.add_column("method")
    table.add_column("rate")
    for column in (*(_heading(n) for n in names), "MB", "primitives", "train s", "encode s", "decode s", "FPS"):
        table.add_column(column, justify="right")
    for record, _ in done:
        means = [record.metrics[n].mean if n in record.metrics else None for n in names]
        table.add_row(
            escape(record.method),
            escape(record.rate or "-"),
            *(_number(n, value) for n, value in zip(names, means, strict=True)),
            f"{record.file.bytes / 1e6:.3f}",
            " / ".join(f"{n:,}" for n in record.counts.values()),
            _seconds(record.train.train_s),
            _seconds(record.codec.encode_s),
            _seconds(record.codec.decode_s),
            f"{record.speed.fps:.1f}",
        )
    out.print(table)
    for reason, affected in reasons_of_metrics([record for record, _ in done]).items():
        out.print(escape(f"{', '.join(affected)}: {reason}"), soft_wrap=True)
    for _, directory in done:
        out.print(f"{escape(str(directory))}/metrics.json", soft_wrap=True)


def reasons_of_metrics(records: list[Record]) -> dict[str, list[str]]:
    """Why metrics have no mean -> which ones."""
    from splatwizard_core.evaluation.metrics import short_reason

    found: dict[str, dict[str, None]] = {}
    for record in records:
        for key, why in record.unknown.items():
            block, _, name = key.partition(".")
            if block == "metrics":
                found.setdefault(short_reason(why), {})[name.removesuffix(".mean")] = None
    return {why: list(names) for why, names in found.items()}


def _heading(metric: str) -> str:
    return {"psnr": "PSNR dB", "ssim": "SSIM", "l1": "L1"}.get(metric, metric)


def _number(metric: str, value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if metric == "psnr" else f"{value:.4f}"


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}" if value >= 10 else f"{value:.2f}"
