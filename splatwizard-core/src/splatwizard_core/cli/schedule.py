"""`sw schedule`: a method's plan as a table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from splatwizard_core.training.stage import Stage


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
    """Print the plan that METHOD executes, stage by stage; needs no data, no device, no training.

    A stage says what trained scene it starts from, and a stage or task of another package which one that is.
    """
    from splatwizard_core.cli.setup import resolve_one
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.training.plan import format_plan, plan_rows, row_facts
    from splatwizard_core.training.scheduler import build_schedulers

    plugins = load_plugins()
    if config_file is None:
        preset = preset or "paper"
    resolved = resolve_one(
        plugins, method, rate, preset=preset, config_file=config_file, values=assignments(sets), scene=None
    )
    from splatwizard_core.plugins.origins import Origins
    from splatwizard_core.runs.phases import stage_parts

    entry, origins = plugins.methods.entry(method), Origins(plugins)
    stages = list(plugins.methods.load(method)(plugins, resolved.config).stages())
    found: list[dict[str, Any]] = []
    for stage in stages:
        pre, post = build_schedulers(stage, resolved.ppl)
        parts = stage_parts(origins, stage, resolved.ppl)
        if as_json:
            plan = plan_rows(pre.registrations, post.registrations, total=stage.iterations)
            rows = [row_facts(row, verbose=verbose) for row in plan]
            found.append(
                {
                    "stage": stage.name, "iterations": stage.iterations, "starts_from": stage.starts_from,
                    "taught_by": list(stage.taught_by), "provided_by": parts, "plan": rows,
                }
            )  # fmt: skip
            continue
        notes = _notes(stage, (entry.distribution, entry.version), origins.of(stage))
        if len(stages) > 1 or notes:
            click.echo(f"{stage.name}: {'; '.join([f'{stage.iterations:,} steps', *notes])}")
        own = origins.of(stage)[0]

        def owner(task: Any, own: str = own) -> str:
            found = origins.of(task)[0]
            return "" if found == own else found

        click.echo(format_plan(pre, post, total=stage.iterations, verbose=verbose, origin=owner))
    if as_json:
        print_json({"method": method, "preset": resolved.preset, "rate": resolved.rate, "stages": found})


def _notes(stage: Stage, method: tuple[str, str], owner: tuple[str, str]) -> list[str]:
    """What the plan of a stage does not show: what it starts from, and whose it is if not the method's own."""
    notes = []
    if stage.starts_from is not None:
        notes.append(f"starts from a trained {stage.starts_from} scene")
    if stage.taught_by:
        notes.append(f"taught by a trained {' and '.join(stage.taught_by)} scene")
    if owner not in (method, ("", "")):
        notes.append(f"of {' '.join(owner)}")
    return notes
