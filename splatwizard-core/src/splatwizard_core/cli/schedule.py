"""`sw schedule`: a method's plan as a table."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from splatwizard_core.cli import options as shared
from splatwizard_core.cli.complete import PRESET, name_of
from splatwizard_core.cli.setup import Choices, takes_choices, tell_data_set_values
from splatwizard_core.plugins import load_plugins

if TYPE_CHECKING:
    from splatwizard_core.training.stage import Stage


@click.command(short_help="a method's plan as a table")
@click.argument("method", type=name_of("method"))
@shared.options(
    click.option("--preset", metavar="NAME", type=PRESET,
                 help="Named values of the method.  [default: paper, or what --config says]"),
    shared.scene_option, shared.rate_option, shared.config_option, shared.set_option,
    click.option("--verbose", is_flag=True, help="Also the first and last step and the number of executions."),
    shared.json_option, shared.debug_option,
)  # fmt: skip
@takes_choices
def schedule(method: str, verbose: bool, as_json: bool, chosen: Choices) -> None:
    """Print the plan that METHOD executes, stage by stage; needs no data, no device, no training.

    A stage says what trained scene it starts from and which values are looked up for the scene, and a stage or task of
    another package which one that is.
    """
    from splatwizard_core.plugins.origins import Origins
    from splatwizard_core.runs.config import read_config_file
    from splatwizard_core.runs.phases import stage_parts
    from splatwizard_core.runs.pretrained import planned_stages
    from splatwizard_core.training.plan import format_plan, plan_rows
    from splatwizard_core.training.scheduler import build_schedulers

    plugins = load_plugins()
    said = read_config_file(chosen.config_file) if chosen.config_file else {}
    preset = chosen.preset or said.get("preset", "paper")
    resolved = replace(chosen, methods=(method,), preset=preset).resolve_one(plugins)
    tell_data_set_values([resolved])
    entry, origins = plugins.methods.entry(method), Origins(plugins)
    stages = planned_stages(plugins, resolved)
    found: list[dict[str, Any]] = []
    for stage in stages:
        pre, post = build_schedulers(stage, resolved.ppl)
        if as_json:
            plan = plan_rows(pre.registrations, post.registrations, total=stage.iterations, verbose=verbose)
            found.append({
                "stage": stage.name, "iterations": stage.iterations, "starts_from": stage.starts_from, "plan": plan,
                "taught_by": list(stage.taught_by), "looked_up": list(stage.looked_up(None)),
                "provided_by": [part.model_dump() for part in stage_parts(origins, stage, resolved.ppl)],
            })  # fmt: skip
            continue
        own = origins.of(stage)
        notes = _notes(stage, (entry.distribution, entry.version), own, str(resolved.pretrained.get("preset", "")))
        if len(stages) > 1 or notes:
            click.echo(f"{stage.name}: {'; '.join([f'{stage.iterations:,} steps', *notes])}")

        def owner(task: Any, own: str = own[0]) -> str:
            found = origins.of(task)[0]
            return "" if found == own else found

        click.echo(format_plan(pre, post, total=stage.iterations, verbose=verbose, origin=owner))
    if as_json:
        shared.print_json({"method": method, "preset": resolved.preset, "rate": resolved.rate, "stages": found})


def _notes(stage: Stage, method: tuple[str, str], owner: tuple[str, str], start: str) -> list[str]:
    """Notes beside the plan of a stage: what it starts from, whose it is if not the method's own, what is looked up."""
    notes = {
        f"starts from a trained {stage.starts_from} scene{start and f' of preset {start}'}": bool(stage.starts_from),
        f"taught by a trained {' and '.join(stage.taught_by)} scene": bool(stage.taught_by),
        f"of {' '.join(owner)}": owner not in (method, ("", "")),
        f"looked up for the scene: {', '.join(stage.looked_up(None))}": bool(stage.looked_up(None)),
    }
    return [note for note, holds in notes.items() if holds]
