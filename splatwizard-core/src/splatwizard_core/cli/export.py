"""`sw export`: a decoded scene in an interchange format."""

from __future__ import annotations

from pathlib import Path

import click

from splatwizard_core.cli import options as shared
from splatwizard_core.cli.complete import complete_files, complete_names
from splatwizard_core.cli.paths import existing_file, output_file
from splatwizard_core.cli.setup import Choices, open_session, takes_choices
from splatwizard_core.plugins import load_plugins


@click.command(short_help=".ply and other interchange formats")
@click.argument("file", metavar="FILE", shell_complete=complete_files)
@click.argument("out", metavar="OUT", shell_complete=complete_files)
@shared.options(
    click.option(
        "--format", "exporter", metavar="NAME", shell_complete=complete_names("exporter"),
        help="Exporter, see `sw list-plugins`.  [default: by the suffix of OUT]",
    ),
    shared.device_option, shared.json_option, shared.debug_option,
)  # fmt: skip
@takes_choices
def export(file: str, out: str, exporter: str | None, as_json: bool, chosen: Choices) -> None:
    """Decode FILE (.swz or .ply) and write it to OUT in another format, such as .ply."""
    from splatwizard_core.runs.decode import export_model
    from splatwizard_core.runs.measure import opener

    path, plugins = existing_file(file), load_plugins()
    output_file(out)
    session = open_session(chosen.resolve_without_method(), plugins)
    model = opener(path, session)().model
    name = export_model(model, Path(out), plugins, exporter)
    facts = {"file": out, "format": name, "bytes": Path(out).stat().st_size, "counts": model.counts()}
    shared.print_facts(facts, as_json, f"{facts['bytes']:,} bytes ({name}): {out}")
