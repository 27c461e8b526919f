"""`sw schedule`: a method's plan as a table."""

from __future__ import annotations

from typing import Any

import click

from splatwizard_core.cli import complete
from splatwizard_core.cli.options import (
    assignments,
    config_option,
    debug_option,
    json_option,
    options,
    print_json,
    rate_option,
    set_option,
)


@click.command(short_help="a method's plan as a table")
@click.argument("method", shell_complete=complete.names("method"))
@options(
    click.option(
        "--preset", metavar="NAME", shell_complete=complete.presets,
        help="Named values of the method.  [default: paper, or what --config says]",
    ),
    rate_option, config_option, set_option,
    click.option("--verbose", is_flag=True, help="Also the first and last step and the number of executions."),
    json_option, debug_option,
)  # fmt: skip
def schedule(
    method: str,
    preset: str | None,
    rate: str | None,
    config_file: str | None,
    sets: tuple[str, ...],
    verbose: bool,
    as_json: bool,
) -> None:
    """Print the plan that METHOD executes, stage by stage; needs no data, no device, no training."""
    import json

    from splatwizard_core.cli.setup import resolve_one
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.training.scheduler import build_schedulers, format_plan

    plugins = load_plugins()
    if config_file is None:
        preset = preset or "paper"
    resolved = resolve_one(
        plugins, method, rate, preset=preset, config_file=config_file, values=assignments(sets), scene=None
    )
    cls = plugins.methods.load(method)
    stages = list(cls(plugins, resolved.config).stages())
    found: list[dict[str, Any]] = []
    texts: list[str] = []
    for stage in stages:
        pre, post = build_schedulers(stage, resolved.ppl)
        if as_json:
            rows = json.loads(format_plan(pre, post, style="json", total=stage.iterations, verbose=verbose))
            found.append(
                {"stage": stage.name, "iterations": stage.iterations, "starts_from": stage.starts_from, "plan": rows}
            )
        else:
            texts.append(format_plan(pre, post, total=stage.iterations, verbose=verbose))
    if as_json:
        print_json({"method": method, "preset": resolved.preset, "rate": resolved.rate, "stages": found})
        return
    for stage, text in zip(stages, texts, strict=True):
        if len(stages) > 1:
            click.echo(f"{stage.name}: {stage.iterations:,} steps")
        click.echo(text)
