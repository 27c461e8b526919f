"""`sw report`: tables, curves, BD-rates and one HTML page about any run directories."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from splatwizard_core.tooling import (
    OUTPUT_FOLDER,
    OUTPUT_PAGE,
    debug_option,
    name_of,
    options,
    print_json,
    say,
)

if TYPE_CHECKING:
    from splatwizard_core.api import Scene
    from sw_report.runs import Run


def _columns(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete the last word of the list."""
    from sw_report.selection import KNOWN

    before, comma, last = incomplete.rpartition(",")
    return [before + comma + name for name in ("all", "paper", *KNOWN) if name.startswith(last)]


@click.command(short_help="tables, curves, BD-rates, one HTML page")
@click.argument("folders", metavar="DIR...", nargs=-1, required=True, type=click.Path())
@options(
    click.option("--html", metavar="FILE", type=OUTPUT_PAGE,
                 help="Write one self-contained page there.  [default: none]"),
    click.option("--survey", metavar="FOLDER", type=OUTPUT_FOLDER,
                 help="Write FOLDER/<dataset>/<scene>/<method>.csv, as the survey of 3DGS compression asks.  "
                 "[default: none]"),
    click.option("--plots", metavar="FOLDER", type=OUTPUT_FOLDER,
                 help="Write FOLDER/rd-<scene>.svg and .pdf, rate-distortion curves for papers; needs matplotlib.  "
                 "[default: none]"),
    click.option("--distance", "sheet", metavar="FILE", type=OUTPUT_PAGE,
                 help="Write one page about how far from the training views models hold.  [default: none]"),
    click.option("--csv", "form", flag_value="csv",
                 help="Print CSV: the survey's columns after what tells runs apart."),
    click.option("--latex", "form", flag_value="latex", help="Print LaTeX tables (booktabs)."),
    click.option("--markdown", "form", flag_value="markdown", help="Print Markdown tables."),
    click.option("--json", "form", flag_value="json", help="Print one JSON object: runs, means, BD values, notes."),
    click.option("--jsonl", "form", flag_value="jsonl", help="Print one JSON object a run."),
    click.option("--columns", metavar="NAME[,NAME]", shell_complete=_columns,
                 help="Columns of the tables: method, rate, scenes, seeds, psnr, ssim, lpips (or any metric of the "
                 "records, diagnostic ones too), size, primitives, steps, train, encode, decode, fps; `all`, or "
                 "`paper`: method, rate, psnr, ssim, lpips, size.  [default: paper with --latex, else all]"),
    click.option("--anchor", metavar="METHOD", type=name_of("method"),
                 help="What BD-rates compare against.  [default: the most usual "
                 "of the methods whose curve overlaps with others]"),
    click.option("--pareto", is_flag=True, help="BD-rates after dropping points that a smaller file equals or beats."),
    click.option("--partial", is_flag=True, help="Means over the scenes that are there, the missing ones named; "
                 "without it, one missing scene leaves no mean."),
    click.option("--pictures/--no-pictures", default=True, show_default=True, help="Renders, ground truth and "
                 "differences in the page; ground truth is what runs kept, else read from their scene."),
    debug_option,
)  # fmt: skip
def report(
    folders: tuple[str, ...],
    html: Path | None,
    survey: Path | None,
    plots: Path | None,
    sheet: Path | None,
    form: str | None,
    columns: str | None,
    anchor: str | None,
    pareto: bool,
    partial: bool,
    pictures: bool,
) -> None:
    """Report on every run under DIR..., wherever they lie: run directories, or trees of them.

    Results are comparable inside one protocol only; runs of different protocols stand in different tables. Without an
    option that prints something else, tables are printed as text.
    """
    from sw_report import exports
    from sw_report.distortion import bd_tables, choose_anchor, why_no_values
    from sw_report.runs import collect
    from sw_report.selection import PAPER, chosen_columns, names_columns, selected

    if columns is not None and form in ("csv", "json", "jsonl"):
        raise click.UsageError(f"--columns is for tables; --{form} has all values")
    collection = collect([Path(folder) for folder in folders])
    against = choose_anchor(collection.runs, anchor)
    if anchor is not None and against is not None:
        values = bd_tables(collection.runs, against, pareto=pareto, partial=partial)
        for line in why_no_values(collection.runs, against, values):
            say(line)
    if html is not None:
        from sw_report.page import PageOptions, write_page

        write_page(collection, html, PageOptions(against, partial, pareto, open_scene, pictures))
        say(f"wrote {html}")
    if survey is not None:
        for path in exports.write_survey(collection.runs, survey):
            say(f"wrote {path}")
    if plots is not None:
        from sw_report.figures import write_figures

        for path in write_figures(collection.runs, plots):
            say(f"wrote {path}")
    if sheet is not None:
        from sw_report.page import write_sheet

        write_sheet(collection, sheet)
        say(f"wrote {sheet}")
    if form == "csv":
        click.echo(exports.to_csv(collection.runs), nl=False)
    elif form == "jsonl":
        click.echo(exports.to_json_lines(collection.runs), nl=False)
    elif form == "json":
        print_json(exports.to_dict(collection, anchor=against, partial=partial, pareto=pareto))
    elif form is not None or not (html or survey or plots or sheet):
        tables = exports.tables_of(
            collection, anchor=against, partial=partial, pareto=pareto, diagnostic=names_columns(columns)
        )
        wanted = chosen_columns(columns, [t for _, t in tables], default=PAPER if form == "latex" else None)
        tables = [(title, selected(table, wanted)) for title, table in tables]
        if form == "latex":
            from sw_report.latex import to_latex

            click.echo(to_latex(tables, collection.notes, collection.runs), nl=False)
        elif form == "markdown":
            click.echo(exports.to_markdown(tables, collection.notes), nl=False)
        else:
            from sw_report.printed import print_tables

            print_tables(tables, collection.notes)
    elif collection.notes:
        for note in collection.notes:
            say(note)


def open_scene(run: Run) -> Scene:
    """Read the scene of a run as the run read it. Raises what reading a scene raises."""
    from splatwizard_core.tooling import Choices, existing_file, load_plugins, load_scene

    resolved = Choices(config_file=str(existing_file(str(run.directory / "config.toml")))).resolve_without_method()
    return load_scene(resolved.scene_spec, resolved.scene, load_plugins())
