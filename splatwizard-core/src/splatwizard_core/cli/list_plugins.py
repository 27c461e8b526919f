"""`sw list-plugins`: what is installed, what each package provides, what is broken and why."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable
from functools import partial
from typing import Any

import click

from splatwizard_core.cli import options as shared
from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.registry import Entry


@click.command("list-plugins", short_help="what is installed, what is broken and why")
@shared.options(
    click.option("--verbose", is_flag=True, help="One line an entry: kind, name, summary."),
    shared.json_option, shared.debug_option,
)  # fmt: skip
def list_plugins(verbose: bool, as_json: bool) -> None:
    """List the installed packages, what each provides, and what is broken and why.

    SW_PLUGINS=a,b in the environment restricts what is loaded (empty: the core alone).
    """
    shared.print_facts(gather(), as_json, partial(_print, verbose=verbose))


def gather() -> dict[str, Any]:
    """Collect installed plugins, name clashes and commands as plain values."""
    from splatwizard_core.cli.main import command_entries  # which finds this command

    plugins = load_plugins()
    rows = [
        {
            **{name: getattr(info, name) for name in ("distribution", "version", "key", "module", "error")},
            "provides": [
                {"kind": e.kind, "name": e.name, "summary": e.summary, "target": e.target, **dict(e.declared)}
                for e in plugins.provided_by(info)
            ],
            "kernels": {} if info.foreign else _kernels(plugins.provided_by(info)),
            "refused": [{"kind": e.kind, "name": e.name, "reason": why} for e, why in plugins.refused_of(info)],
        }
        for info in plugins.plugins
    ]
    clashes = [
        {"kind": kind, "name": name, "distributions": [f"{e.distribution} {e.version}" for e in entries]}
        for kind, registry in plugins.registries.items()
        for name, entries in registry.clashes.items()
    ]
    return {"plugins": rows, "clashes": clashes, "commands": [entry.name for entry in command_entries()]}


def _kernels(entries: Iterable[Entry]) -> dict[str, str]:
    """Collect the states of the native modules that entries compute with: prebuilt, built, damaged, or reference."""
    declared = [entry.declared.get("native") or () for entry in entries]
    targets = [target for each in declared for target in ([each] if isinstance(each, str) else each)]
    modules = [pkgutil.resolve_name(target) for target in dict.fromkeys(targets)]
    return {module.name: module.state()["state"] for module in modules}


def _print(found: dict[str, Any], *, verbose: bool) -> None:
    from rich.markup import escape

    rows = []
    for row in found["plugins"]:
        by_kind: dict[str, list[str]] = {}
        for entry in row["provides"]:
            default = " (default)" if entry.get("default") else ""
            kernels = f" (kernels of {escape(str(entry['kernels']))})" if entry.get("kernels") else ""
            also = f" (also {escape(', '.join(entry['aliases']))})" if entry.get("aliases") else ""
            by_kind.setdefault(entry["kind"], []).append(escape(entry["name"]) + default + kernels + also)
        lines = [f"[bold]{kind}[/bold]: {', '.join(names)}" for kind, names in by_kind.items()]
        if verbose:
            lines = [f"[bold]{e['kind']}[/bold] {escape(e['name'])}: {escape(e['summary'])}" for e in row["provides"]]
        if row["kernels"]:
            lines.append(f"[bold]kernels[/bold]: {', '.join(f'{n} ({state})' for n, state in row['kernels'].items())}")
        if row["error"]:
            lines.append(f"[red]broken: {escape(row['error'])}[/red]")
        for each in row["refused"]:
            lines.append(f"[red]refused: {each['kind']} '{escape(each['name'])}': {escape(each['reason'])}[/red]")
        rows.append([escape(row["distribution"]), row["version"], "\n".join(lines) or "-"])
    out = shared.console()
    if not verbose:
        shared.print_table(["distribution", "version", "provides"], rows, title="Installed packages", markup=True)
    for distribution, version, text in rows if verbose else ():
        out.print(f"{distribution} {version}\n{text}".replace("\n", "\n  "), soft_wrap=True)
    for clash in found["clashes"]:
        owners = " and ".join(clash["distributions"])
        out.print(
            f"[red]{clash['kind']} '{escape(clash['name'])}' is claimed by {escape(owners)}[/red]: "
            "uninstall one, or restrict with SW_PLUGINS"
        )
    broken = sum(row["error"] is not None for row in found["plugins"])
    if broken:
        out.print(f"{broken} broken; the other plugins are not affected")
