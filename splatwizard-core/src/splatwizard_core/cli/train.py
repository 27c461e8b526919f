"""`sw train`: the training step alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from splatwizard_core.base.progress import counted
from splatwizard_core.cli import options as shared
from splatwizard_core.cli.setup import Choices, only, open_training_session, takes_choices
from splatwizard_core.plugins import load_plugins

REPORTED = {"steps", "train_s", "stages", "peak_bytes", "memory_kind", "breakdown_s", "pretraining"}


@click.command(short_help="train one method on one scene")
@shared.options(
    shared.method_option, shared.scene_option, shared.images_option, shared.rate_option, shared.preset_option,
    shared.init_option, shared.config_option, shared.set_option, shared.out_option, shared.device_option,
    shared.seed_option, shared.resume_option, shared.changed_plan_option, shared.json_option, shared.debug_option,
    click.option("--view", is_flag=False, flag_value=8080, type=click.IntRange(1, 65535), metavar="[PORT]",
                 help="Show the training in the browser, by a viewer's package.  [default: not; without PORT: 8080]"),
)  # fmt: skip
@takes_choices
def train(out: Path, resume: bool, allow_changed_plan: bool, as_json: bool, view: int | None, chosen: Choices) -> None:
    """Train one method on one scene; checkpoints and log go into its run directory."""
    from splatwizard_core.runs.directory import RunRequest
    from splatwizard_core.runs.run import train_only

    plugins = load_plugins()
    if view:
        plugins.commands.load("view")  # without the package, its name is told before the training
        chosen = replace(chosen, below={"log.view": view})
    resolved, session = open_training_session(chosen, plugins)
    trained, directory = train_only(session, RunRequest(only(resolved), out, resume, allow_changed_plan))
    facts: dict[str, Any] = {"directory": str(directory), "counts": trained.model.counts()}
    facts |= trained.facts.model_dump(mode="json", include=REPORTED)
    told = f"{facts['steps']:,} steps in {facts['train_s']:.1f} s, {counted(facts['counts'])}: {directory}"
    shared.print_facts(facts, as_json, told)
