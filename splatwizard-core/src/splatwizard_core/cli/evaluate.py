"""`sw eval`: image quality, speed and memory of an encoded scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from splatwizard_core.cli.options import (
    assignments,
    config_option,
    console,
    debug_option,
    device_option,
    images_option,
    json_option,
    options,
    print_json,
    scene_option,
    seed_option,
    set_option,
)
from splatwizard_core.cli.setup import existing, open_session, resolve_run_options


@click.command("eval", short_help="quality, speed and memory of an encoded scene")
@click.argument("file", metavar="FILE")
@options(
    scene_option, images_option, config_option, set_option,
    click.option("--metrics", metavar="NAME[,NAME]", help="Which metrics.  [default: every one that is installed]"),
    click.option("--renders", metavar="DIR", help="Keep the rendered test views there as PNG."),
    click.option("--no-speed", is_flag=True, help="Leave out rendering speed and memory."),
    device_option, seed_option, json_option, debug_option,
)  # fmt: skip
def evaluate(
    file: str,
    scene: str | None,
    images: str | None,
    config_file: str | None,
    sets: tuple[str, ...],
    metrics: str | None,
    renders: str | None,
    no_speed: bool,
    device: str | None,
    seed: int | None,
    as_json: bool,
) -> None:
    """Measure FILE (.swz, or a .ply without codec) on the test views of a scene, by the protocol.

    The model is opened before the scene is read. --set takes scene keys (resolution, test_every, background, ...) and
    keys of the run (raster.prefer, threads, ...).
    """
    from splatwizard_core.experiments.measuring import measure, opener
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.scene.loaders import load_scene

    path = existing(file)
    plugins = load_plugins()
    ppl, scene_options, said_scene = resolve_run_options(
        config_file, assignments(sets, images=images, device=device, seed=seed)
    )
    spec = scene or said_scene or "demo"
    session = open_session(ppl, plugins)
    facts: dict[str, Any] = measure(
        opener(path, plugins, session.device),
        lambda: load_scene(spec, scene_options, plugins),
        plugins,
        session.device,
        ppl,
        metrics=[m.strip() for m in metrics.split(",") if m.strip()] if metrics else None,
        speed=not no_speed,
        renders=Path(renders) if renders else None,
    )
    if as_json:
        print_json({"file": {"path": str(path), "bytes": path.stat().st_size}, **facts})
    else:
        _print(path, facts)


def _print(path: Path, facts: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table(
        title=f"{escape(path.name)} on {escape(facts['scene'])}, protocol {escape(facts['protocol']['id'])}",
        title_justify="left",
        show_header=False,
    )
    for name, metric in facts["metrics"].items():
        shown = "-" if metric["mean"] is None else f"{metric['mean']:.4f}"
        table.add_row(escape(name), f"{shown}  ({metric['direction']} is better, {len(facts['views'])} views)")
    table.add_row("bytes", f"{path.stat().st_size:,}")
    for name, count in facts["counts"].items():
        table.add_row(name.removeprefix("num_"), f"{count:,}")
    table.add_row("visible, mean of views", f"{facts['visible_gaussians']:,.0f}")
    if facts["speed"] is not None:
        speed, memory = facts["speed"], facts["memory"]
        width, height = speed["image_size"]
        table.add_row(
            "speed", f"{speed['fps']:.1f} frames/s at {width}x{height}, median {speed['latency_ms_median']:.1f} ms"
        )
        table.add_row("peak memory", f"{memory['peak_render_bytes'] / 1e6:,.0f} MB ({memory['kind']})")
    out = console()
    out.print(table)
    for name, reason in facts["unknown"].items():
        out.print(escape(f"{name}: {reason}"))
