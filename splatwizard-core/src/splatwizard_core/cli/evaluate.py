"""`sw eval`: image quality, speed and memory of an encoded scene."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from splatwizard_core.base.files import scratch_folder
from splatwizard_core.cli import options as shared
from splatwizard_core.cli.complete import name_of
from splatwizard_core.cli.paths import EXISTING, OUTPUT_FOLDER
from splatwizard_core.cli.setup import Choices, open_session, takes_choices, warn_of_metrics
from splatwizard_core.errors import SplatwizardError
from splatwizard_core.plugins import load_plugins


@click.command("eval", short_help="quality, speed and memory of an encoded scene")
@click.argument("file", metavar="FILE", type=EXISTING)
@shared.options(
    shared.scene_option, shared.images_option, shared.config_option, shared.set_option,
    click.option(
        "--metrics", metavar="NAME[,NAME]", type=name_of("metric"),
        help="Which metrics.  [default: all over images that are installed, but slow diagnostics]",
    ),
    click.option(
        "--renders", metavar="DIR", type=OUTPUT_FOLDER,
        help="Keep the rendered test views there as PNG, and what shows the geometry.  [default: they are not kept]",
    ),
    click.option(
        "--roundtrip", is_flag=True,
        help="Of a run directory: encode it, decode the file in a fresh process, measure that.",
    ),
    click.option(
        "--prefixes", is_flag=True,
        help="Of a file with cuts: measure each prefix too, by --metrics, else PSNR and SSIM.",
    ),
    click.option("--no-speed", is_flag=True, help="Leave out rendering speed and memory."),
    shared.repeats_option, shared.geometry_option,
    click.option("--quiet", is_flag=True, help="Do not warn of metrics that cannot be computed."),
    shared.device_option, shared.seed_option, shared.json_option, shared.debug_option,
)  # fmt: skip
@takes_choices
def evaluate(
    file: Path,
    metrics: str | None,
    renders: Path | None,
    roundtrip: bool,
    prefixes: bool,
    no_speed: bool,
    repeats: int,
    geometry: bool,
    quiet: bool,
    as_json: bool,
    chosen: Choices,
) -> None:
    """Measure FILE on the test views of a scene, by the protocol.

    FILE is a .swz, a .ply, or a run directory: then its trained model without codec. Without --scene the scene is
    that of the run directory, or of the one that the file lies in. Of a file, the model is opened before the scene is
    read. --set takes scene keys (resolution, test_every, background, ...), keys of the run (raster.prefer, threads,
    ...) and settings of metrics (metrics.GROUP.KEY).
    """
    from splatwizard_core.runs.encode import encode_directory, finished_training
    from splatwizard_core.runs.fresh import decode_fresh
    from splatwizard_core.runs.measure import Opened, measure, measure_prefixes, opener

    plugins = load_plugins()
    names = None if metrics is None else [m.strip() for m in metrics.split(",") if m.strip()]
    if names == []:
        raise click.UsageError("--metrics is empty: give names, or leave it out")
    if file.is_dir():
        config = file / "config.toml"
        if not config.exists():
            raise click.UsageError(f"{file} is no run directory, it has no config.toml: give <scene>/<method>/<rate>")
        resolved = replace(chosen, config_file=chosen.config_file or str(config)).resolve_one(plugins)
    elif roundtrip:
        raise click.UsageError("--roundtrip is for a run directory; a file has been encoded already")
    else:
        resolved = chosen.of_file(file).resolve_without_method()
    session = open_session(resolved, plugins)
    warn_of_metrics(session, names, resolved.metrics, geometry=geometry, quiet=quiet)

    def open_trained() -> Opened:
        with finished_training(session, resolved, file) as trained:
            return Opened(trained.model.eval().requires_grad_(False), trained.facts.raster)

    with contextlib.ExitStack() as stack:
        measured, digest = file, None
        if roundtrip:
            measured = stack.enter_context(scratch_folder("roundtrip")) / "scene.swz"
            encode_directory(session, resolved, file, measured)
            digest = decode_fresh(measured, str(session.device), threads=resolved.ppl.threads).digest
        found = measure(
            session, resolved, open_trained if measured.is_dir() else opener(measured, session),
            metrics=names, geometry=geometry, speed=not no_speed, repeats=repeats, renders=renders,
        )  # fmt: skip
        size = None if measured.is_dir() else measured.stat().st_size
        if prefixes and size is not None and session.plugins.importers.of_suffix(measured) is None:
            rows = measure_prefixes(session, resolved, measured, names or ["psnr", "ssim"])
            found = found.model_copy(update={"prefixes": rows})
    if digest not in (None, found.digest):
        raise SplatwizardError(f"{file}: two processes decode different models from the same file")
    facts = found.model_dump(mode="json", exclude={"asked"})
    shared.print_facts({"file": {"path": str(file), "bytes": size}, **facts}, as_json, _print)


def _print(facts: dict[str, Any]) -> None:
    from splatwizard_core.evaluation.metrics import short_reason

    rows = []
    for name, metric in sorted(facts["metrics"].items(), key=lambda item: item[1]["diagnostic"]):
        shown = "-" if metric["mean"] is None else f"{metric['mean']:.4f}"
        kind = "diagnostic" if metric["diagnostic"] else f"{metric['direction']} is better"
        over = f", {len(facts['views'])} views" if name not in (facts["geometry"] or {}) else ""
        rows.append([name, f"{shown}  ({kind}{over})"])
    if facts["training_psnr"] is not None:
        psnrs = (facts["training_psnr"][key] for key in ("mean", "quantile_05"))
        mean, low = ("-" if value is None else f"{value:.4f}" for value in psnrs)
        rows.append(["psnr, training views", f"{mean}  ({facts['train_views']} views, 5 % have {low} or less)"])
    if facts["file"]["bytes"] is not None:
        rows.append(["bytes", f"{facts['file']['bytes']:,}"])
    rows += [[name.removeprefix("num_"), f"{count:,}"] for name, count in facts["counts"].items()]
    rows.append(["visible, mean of views", f"{facts['visible_gaussians']:,.0f}"])
    if facts["speed"] is not None:
        speed, memory = facts["speed"], facts["memory"]
        size = "x".join(map(str, speed["image_size"]))
        rows.append(["speed", f"{speed['fps']:.1f} frames/s at {size}, median {speed['latency_ms_median']:.1f} ms"])
        if speed["spread"] is not None:
            fps = speed["spread"]["fps"]
            spread = f"deviation {fps['std']:.1f}, {fps['min']:.1f} to {fps['max']:.1f} frames/s"
            rows.append(["speed, repeated", f"{fps['n']} times: mean {fps['mean']:.1f}, {spread}"])
        rows.append(["load", f"{speed['load_s']:.2f} s to the first frame, kernels {speed['jit_s']:.2f} s apart"])
        rows.append(["peak memory", f"{memory['peak_render_bytes'] / 1e6:,.0f} MB ({memory['kind']})"])
    name = Path(facts["file"]["path"]).name
    shared.print_table([], rows, title=f"{name} on {facts['scene']}, protocol {facts['protocol']['id']}")
    if facts["prefixes"]:
        names = list(facts["prefixes"][0]["metrics"])
        cells = [[f"{cut['packets']}", f"{cut['bytes']:,}", *(f"{cut['metrics'].get(n, math.nan):.4f}" for n in names)]
                 for cut in facts["prefixes"]]  # fmt: skip
        shared.print_table(["packets", "bytes", *names], cells, right=2 + len(names))
    reasons = {name: short_reason(reason) for name, reason in facts["unknown"].items()}
    for reason in dict.fromkeys(reasons.values()):
        those = (each.removeprefix("metrics.").removesuffix(".mean") for each in reasons if reasons[each] == reason)
        click.echo(f"{', '.join(those)}: {reason}")
