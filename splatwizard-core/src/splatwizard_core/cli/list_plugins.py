"""`sw list-plugins`: what is installed, what each package provides, what is broken and why."""

from __future__ import annotations

from typing import Any

import click

from splatwizard_core.cli.options import console, debug_option, json_option, options, print_json


@click.command("list-plugins", short_help="what is installed, what is broken and why")
@options(json_option, debug_option)
def list_plugins(as_json: bool) -> None:
    """Installed packages, what each provides, and what is broken and why.

    SW_PLUGINS=a,b in the environment restricts what is loaded (empty: the core alone).
    """
    found = gather()
    if as_json:
        print_json(found)
    else:
        _print(found)


def gather() -> dict[str, Any]:
    """Installed plugins, name clashes and commands as plain values."""
    from splatwizard_core.cli.main import command_entries
    from splatwizard_core.plugins import load_plugins

    plugins = load_plugins()
    rows = []
    for info in plugins.plugins:
        provides = [
            {"kind": e.kind, "name": e.name, "summary": e.summary, "target": e.target, **dict(e.declared)}
            for e in plugins.provided_by(info)
        ]
        rows.append(
            {
                "distribution": info.distribution,
                "version": info.version,
                "key": info.key,
                "module": info.module,
                "provides": provides,
                "error": info.error,
            }
        )
    clashes = [
        {"kind": kind, "name": name, "distributions": [f"{e.distribution} {e.version}" for e in entries]}
        for kind, registry in plugins.registries.items()
        for name, entries in registry.clashes.items()
    ]
    return {"plugins": rows, "clashes": clashes, "commands": [entry.name for entry in command_entries()]}


def _print(found: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    out = console()
    table = Table(title="Installed packages", title_justify="left")
    for column in ("distribution", "version", "provides"):
        table.add_column(column, overflow="fold")
    for row in found["plugins"]:
        by_kind: dict[str, list[str]] = {}
        for entry in row["provides"]:
            by_kind.setdefault(entry["kind"], []).append(escape(entry["name"]))
        lines = [f"[bold]{kind}[/bold]: {', '.join(names)}" for kind, names in by_kind.items()]
        if row["error"]:
            lines.append(f"[red]broken: {escape(row['error'])}[/red]")
        table.add_row(escape(row["distribution"]), row["version"], "\n".join(lines) or "-")
    out.print(table)
    for clash in found["clashes"]:
        owners = " and ".join(clash["distributions"])
        out.print(
            f"[red]{clash['kind']} '{escape(clash['name'])}' is claimed by {escape(owners)}[/red]: "
            "uninstall one, or restrict with SW_PLUGINS"
        )
    broken = sum(row["error"] is not None for row in found["plugins"])
    if broken:
        out.print(f"{broken} broken; the other plugins are not affected")
