"""`sw train`: the training step alone."""

from __future__ import annotations

from pathlib import Path

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
    method_option,
    options,
    preset_option,
    print_json,
    rate_option,
    resume_option,
    scene_option,
    seed_option,
    set_option,
)
from splatwizard_core.cli.setup import open_session, output_folder, resolve_one, say_device


@click.command(short_help="train one method on one scene")
@options(
    method_option, scene_option, images_option, rate_option, preset_option, init_option, config_option, set_option,
    click.option(
        "--out", default="out", show_default=True, metavar="DIR", shell_complete=complete.folders,
        help="Root of the run directories, DIR/<scene>/<method>/<rate>; `sw run` with the same options goes on there.",
    ),
    device_option, seed_option, resume_option, changed_plan_option, json_option, debug_option,
)  # fmt: skip
def train(
    method: str | None,
    scene: str | None,
    images: str | None,
    rate: str | None,
    preset: str | None,
    init: str | None,
    config_file: str | None,
    sets: tuple[str, ...],
    out: str,
    device: str | None,
    seed: int | None,
    resume: bool,
    allow_changed_plan: bool,
    as_json: bool,
) -> None:
    """Train one method on one scene; checkpoints and log go into its run directory."""
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.runs.run import RunRequest, train_only
    from splatwizard_core.runs.training import pretraining

    plugins = load_plugins()
    values = assignments(sets, images=images, device=device, seed=seed, init=init)
    resolved = resolve_one(plugins, method, rate, preset=preset, config_file=config_file, values=values, scene=scene)
    output_folder(out)
    session = open_session(resolved.ppl, plugins)
    session.scene(resolved)  # what is wrong with it is told before anything else is said
    say_device(resolved.ppl, session)
    request = RunRequest(resolved, Path(out), resume=resume, allow_changed_plan=allow_changed_plan)
    trained, directory = train_only(session, request)
    facts = {
        "directory": str(directory),
        "counts": trained.model.counts(),
        **{k: trained.facts[k] for k in ("steps", "train_s", "stages", "peak_bytes", "memory_kind", "breakdown_s")},
        "pretraining": pretraining(trained.facts),
    }
    if as_json:
        print_json(facts)
        return
    counted = ", ".join(f"{n:,} {name.removeprefix('num_')}" for name, n in facts["counts"].items())
    click.echo(f"{facts['steps']:,} steps in {facts['train_s']:.1f} s, {counted}: {directory}")
