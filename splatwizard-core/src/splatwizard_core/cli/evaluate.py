"""`sw eval`: image quality, speed and memory of an encoded scene."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from splatwizard_core.cli import complete
from splatwizard_core.cli.options import (
    assignments,
    config_option,
    console,
    debug_option,
    device_option,
    images_option,
    json_option,
    lpips_option,
    options,
    print_json,
    repeats_option,
    scene_option,
    seed_option,
    set_option,
)
from splatwizard_core.cli.setup import (
    existing,
    lpips_folder,
    metric_settings,
    open_session,
    output_folder,
    resolve_one,
    resolve_run_options,
)
from splatwizard_core.errors import SplatwizardError
from splatwizard_core.files import scratch_folder

if TYPE_CHECKING:
    pass


@click.command("eval", short_help="quality, speed and memory of an encoded scene")
@click.argument("file", metavar="FILE", shell_complete=complete.files)
@options(
    scene_option, images_option, config_option, set_option,
    click.option(
        "--metrics", metavar="NAME[,NAME]", shell_complete=complete.names("metric"),
        help="Which metrics.  [default: every one that is installed]",
    ),
    lpips_option,
    click.option(
        "--renders", metavar="DIR", shell_complete=complete.folders,
        help="Keep the rendered test views there as PNG.  [default: they are not kept]",
    ),
    click.option(
        "--roundtrip", is_flag=True,
        help="Of a run directory: encode it, decode the file in a fresh process, measure that.",
    ),
    click.option("--no-speed", is_flag=True, help="Leave out rendering speed and memory."),
    repeats_option,
    click.option("--quiet", is_flag=True, help="Do not warn of metrics that cannot be computed."),
    device_option, seed_option, json_option, debug_option,
)  # fmt: skip
def evaluate(
    file: str,
    scene: str | None,
    images: str | None,
    config_file: str | None,
    sets: tuple[str, ...],
    metrics: str | None,
    lpips_weights: str | None,
    renders: str | None,
    roundtrip: bool,
    no_speed: bool,
    repeats: int,
    quiet: bool,
    device: str | None,
    seed: int | None,
    as_json: bool,
) -> None:
    """Measure FILE on the test views of a scene, by the protocol.

    FILE is a .swz, a .ply, or a run directory: then its trained model without codec, on its own scene. Of a file, the
    model is opened before the scene is read. --set takes scene keys (resolution, test_every, background, ...) and keys
    of the run (raster.prefer, threads, ...).
    """
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.runs.measure import Opened, measure, opener
    from splatwizard_core.scene.loading import load_scene

    path = existing(file)
    wanted = None if metrics is None else [m.strip() for m in metrics.split(",") if m.strip()]
    if wanted == []:
        raise click.UsageError("--metrics is empty: give names, or leave it out")
    plugins = load_plugins()
    for name in wanted or ():
        plugins.metrics.entry(name)
    if renders is not None:
        output_folder(renders)
    values = assignments(sets, images=images, device=device, seed=seed)
    if lpips_weights is not None:
        values["metrics.lpips.weights"] = str(Path(lpips_weights).resolve())
    settings = metric_settings(plugins, values)
    stored = path.is_dir()
    if stored:
        if not (path / "config.toml").exists():
            raise click.UsageError(f"{file} is no run directory, it has no config.toml: give <scene>/<method>/<rate>")
        config_file = config_file or str(path / "config.toml")
        resolved = resolve_one(plugins, None, None, preset=None, config_file=config_file, values=values, scene=scene)
        ppl, scene_options, spec = resolved.ppl, resolved.scene, resolved.scene_spec
    elif roundtrip:
        raise click.UsageError("--roundtrip is for a run directory; a file has been encoded already")
    else:
        ppl, scene_options, said_scene = resolve_run_options(config_file, values)
        spec = scene or said_scene or "demo"
    asks_lpips = wanted is None or any(name.startswith("lpips") for name in wanted)
    lpips_folder(lpips_weights, quiet=quiet or not asks_lpips)
    session = open_session(ppl, plugins)

    with contextlib.ExitStack() as stack:
        if not stored:
            open_model = opener(path, plugins, session.device)
        elif roundtrip:
            from splatwizard_core.runs.encode import encode_directory
            from splatwizard_core.runs.fresh import decode_fresh

            path = stack.enter_context(scratch_folder("roundtrip")) / "scene.swz"
            encode_directory(session, resolved, Path(file), path)
            digest = decode_fresh(path, str(session.device))["digest"]
            open_model = opener(path, plugins, session.device)
        else:
            from splatwizard_core.runs.encode import load_finished

            def open_model() -> Opened:
                trained = load_finished(session, resolved, path)
                return Opened(trained.model.eval().requires_grad_(False), trained.facts["raster"])

        facts: dict[str, Any] = measure(
            open_model,
            lambda: load_scene(spec, scene_options, plugins),
            plugins,
            session.device,
            ppl,
            metrics=wanted,
            metric_settings=settings,
            speed=not no_speed,
            repeats=repeats,
            renders=Path(renders) if renders else None,
            load_kernels=session.load_kernels,
        )
        size = None if path.is_dir() else path.stat().st_size
    if roundtrip and facts["digest"] != digest:
        raise SplatwizardError(f"{file}: two processes decode different models from the same file")
    facts = {"file": {"path": file, "bytes": size}, **facts}
    if as_json:
        print_json(facts)
    else:
        _print(facts)


def _print(facts: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    from splatwizard_core.evaluation.metrics import short_reason

    name = Path(facts["file"]["path"]).name
    table = Table(
        title=f"{escape(name)} on {escape(facts['scene'])}, protocol {escape(facts['protocol']['id'])}",
        title_justify="left",
        show_header=False,
    )
    for name, metric in sorted(facts["metrics"].items(), key=lambda item: item[1]["diagnostic"]):
        shown = "-" if metric["mean"] is None else f"{metric['mean']:.4f}"
        kind = "diagnostic" if metric["diagnostic"] else f"{metric['direction']} is better"
        table.add_row(escape(name), f"{shown}  ({kind}, {len(facts['views'])} views)")
    if facts["file"]["bytes"] is not None:
        table.add_row("bytes", f"{facts['file']['bytes']:,}")
    for name, count in facts["counts"].items():
        table.add_row(name.removeprefix("num_"), f"{count:,}")
    table.add_row("visible, mean of views", f"{facts['visible_gaussians']:,.0f}")
    if facts["speed"] is not None:
        speed, memory = facts["speed"], facts["memory"]
        width, height = speed["image_size"]
        table.add_row(
            "speed", f"{speed['fps']:.1f} frames/s at {width}x{height}, median {speed['latency_ms_median']:.1f} ms"
        )
        if speed["spread"] is not None:
            fps = speed["spread"]["fps"]
            table.add_row(
                "speed, repeated",
                f"{fps['n']} times: mean {fps['mean']:.1f}, deviation {fps['std']:.1f}, "
                f"{fps['min']:.1f} to {fps['max']:.1f} frames/s",
            )
        table.add_row("load", f"{speed['load_s']:.2f} s to the first frame, kernels {speed['jit_s']:.2f} s apart")
        table.add_row("peak memory", f"{memory['peak_render_bytes'] / 1e6:,.0f} MB ({memory['kind']})")
    out = console()
    out.print(table)
    for name, reason in facts["unknown"].items():
        out.print(escape(f"{name.removeprefix('metrics.').removesuffix('.mean')}: {short_reason(reason)}"))
