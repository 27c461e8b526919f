"""`sw export`: a decoded scene in an interchange format."""

from __future__ import annotations

from pathlib import Path

import click

from splatwizard_core.cli import options as shared
from splatwizard_core.cli.complete import name_of
from splatwizard_core.cli.paths import INPUT_FILE, OUTPUT_FILE
from splatwizard_core.cli.setup import Choices, open_session, takes_choices
from splatwizard_core.plugins import load_plugins


@click.command(short_help=".ply and other interchange formats")
@click.argument("file", metavar="FILE", type=INPUT_FILE)
@click.argument("out", metavar="OUT", type=OUTPUT_FILE)
@shared.options(
    click.option(
        "--format", "exporter", metavar="NAME", type=name_of("exporter"),
        help="Exporter, see `sw list-plugins`.  [default: by the suffix of OUT]",
    ),
    click.option(
        "--world", is_flag=True,
        help="Write coordinates of the world that the scene's files are in, where the scene was moved to a local "
        "origin: as doubles in a .ply.",
    ),
    shared.device_option, shared.json_option, shared.debug_option,
)  # fmt: skip
@takes_choices
def export(file: Path, out: Path, exporter: str | None, world: bool, as_json: bool, chosen: Choices) -> None:
    """Decode FILE (.swz, .ply or another format) and write it to OUT in the format of its suffix, such as .ply."""
    from splatwizard_core.base.files import bytes_with_named
    from splatwizard_core.gaussians.placement import in_world
    from splatwizard_core.runs.decode import export_model
    from splatwizard_core.runs.measure import opener

    plugins = load_plugins()
    session = open_session(chosen.resolve_without_method(), plugins)
    model = opener(file, session)().model
    if world:
        model = in_world(model, file.name)
    name = export_model(model, out, plugins, exporter)
    facts = {"file": str(out), "format": name, "bytes": bytes_with_named(out), "counts": model.counts()}
    shared.print_facts(facts, as_json, f"{facts['bytes']:,} bytes ({name}): {out}")
