"""Tables as text on a terminal, for the commands."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatwizard_core.tooling import console

if TYPE_CHECKING:
    from sw_report.blocks import Table


def print_tables(tables: list[tuple[str, Table]], notes: list[str]) -> None:
    """Print tables as text on stdout."""
    from rich.markup import escape
    from rich.table import Table as Drawn

    out = console()
    for title, table in tables:
        drawn = Drawn(title=escape(title), title_justify="left")
        for i, column in enumerate(table.columns):
            drawn.add_column(escape(column.name), justify="left" if column.text or not i else "right")
        for row in table.rows:
            cells = [f"[bold]*{escape(cell.text)}[/bold]" if cell.best else escape(cell.text) for cell in row.cells]
            drawn.add_row(*cells, end_section=row.emphasis)
        out.print(drawn)
        if table.has_best:
            out.print("* best of its column")
        for note in table.notes:
            out.print(escape(note), soft_wrap=True)
        out.print()
    for note in notes:
        out.print(escape(f"note: {note}"), soft_wrap=True)
