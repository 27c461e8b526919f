"""`sw compare`: what was measured, beside what was published."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from splatwizard_core.tooling import debug_option, json_option, options, print_facts


@click.command(short_help="a run beside published figures")
@click.argument("folders", metavar="RUN...", nargs=-1, required=True, type=click.Path())
@options(
    click.option("--published", is_flag=True, help="Compare with published figures of the same data set and scene."),
    click.option("--own", is_flag=True, help="Published figures of the measured methods alone."),
    json_option, debug_option,
)  # fmt: skip
def compare(folders: tuple[str, ...], published: bool, own: bool, as_json: bool) -> None:
    """Compare every run under RUN... with published figures, scene by scene, and means over whole data sets.

    Each figure is told with its source and year, and with what differs between its protocol and the run's. Figures that
    were not re-read at their source are marked.
    """
    if not published:
        raise click.UsageError("say what to compare with: --published takes the published figures")
    from sw_report.beside_tables import beside_tables, to_dict
    from sw_report.printed import print_tables
    from sw_report.runs import collect

    collection = collect([Path(folder) for folder in folders])
    tables = beside_tables(collection.runs, others=not own)

    def told(facts: dict[str, Any]) -> None:
        print_tables([(table.title, table.drawn()) for table in tables], facts["notes"])

    print_facts({"tables": [to_dict(table) for table in tables], "notes": collection.notes}, as_json, told)
