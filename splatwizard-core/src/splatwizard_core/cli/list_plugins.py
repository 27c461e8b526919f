"""`sw list-plugins`: what is installed, what each package provides, what is broken and why."""

from __future__ import annotations

from typing import Any

import click

from splatwizard_core.cli.options import console, debug_option, json_option, options, print_json


@click.command("list-plugins", short_help="what is installed, what is broken and why")
@options(json_option, debug_option)
@click.pass_context
def list_plugins(ctx: click.Context, as_json: bool) -> None:
    """Installed packages, what each provides, and what is broken and why.

    SW_PLUGINS=a,b in the environment restricts what is loaded (empty: the core alone).
    """
    found = gather(ctx.find_root().command)
    if as_json:
        print_json(found)
    else:
        _print(found)


def gather(root: click.Command) -> dict[str, Any]:
    """What is installed, as plain values: {"plugins": [...], "clashes": [...]}."""
    from splatwizard_core.cli.main import COMMANDS, LazyGroup
    from splatwizard_core.plugins import load_plugins

    plugins = load_plugins()
    if isinstance(root, LazyGroup):
        root.ask_plugins()  # a command that cannot be added makes its plugin a broken one
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
    extra = sorted(root.commands) if isinstance(root, LazyGroup) else []
    return {"plugins": rows, "clashes": clashes, "commands": [*COMMANDS, *extra]}


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
