"""`sw export`: a decoded scene in an interchange format."""

from __future__ import annotations

from pathlib import Path

import click

from splatwizard_core.cli import complete
from splatwizard_core.cli.options import assignments, debug_option, device_option, json_option, options, print_json
from splatwizard_core.cli.setup import existing_file, open_session, output_file, resolve_run_options


@click.command(short_help=".ply and other interchange formats")
@click.argument("file", metavar="FILE", shell_complete=complete.files)
@click.argument("out", metavar="OUT", shell_complete=complete.files)
@options(
    click.option(
        "--format", "exporter", metavar="NAME", shell_complete=complete.names("exporter"),
        help="Exporter, see `sw list-plugins`.  [default: by the suffix of OUT]",
    ),
    device_option, json_option, debug_option,
)  # fmt: skip
def export(file: str, out: str, exporter: str | None, device: str | None, as_json: bool) -> None:
    """Decode FILE (.swz or .ply) and write it to OUT in another format, such as .ply."""
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.runs.decode import export_model
    from splatwizard_core.runs.measure import opener

    path = existing_file(file)
    output_file(out)
    plugins = load_plugins()
    ppl, _, _ = resolve_run_options(None, assignments((), device=device))
    session = open_session(ppl, plugins)
    model = opener(path, plugins, session.device)().model
    target = Path(out)
    name = export_model(model, target, plugins, exporter)
    facts = {"file": out, "format": name, "bytes": target.stat().st_size, "counts": model.counts()}
    if as_json:
        print_json(facts)
    else:
        click.echo(f"{facts['bytes']:,} bytes ({name}): {out}")
