"""`sw doctor`: what works on this machine, and what to install for the rest."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import click

from splatwizard_core.tooling import as_installed, debug_option, json_option, options, print_json

if TYPE_CHECKING:
    from sw_doctor.diagnosis import Diagnosis

COLOURS = {"ok": "green", "missing": "yellow", "broken": "red"}


@click.command(short_help="what works here, and what to install for the rest")
@options(json_option, debug_option)
def doctor(as_json: bool) -> None:
    """Try what `sw` needs on this machine: ok, missing or broken, and the line that mends it.

    Kernels that are built are loaded, compilers compile a few lines, rasterizers draw a small picture, packages are
    imported; nothing is installed or built. Exit status 1 if `sw run` on the demo scene cannot run here.
    """
    from sw_doctor.diagnosis import examine

    found = examine()
    found = replace(found, checks=[replace(each, mend=each.mend and as_installed(each.mend)) for each in found.checks])
    if as_json:
        print_json(found.as_dict())
    else:
        _print(found)
    if not found.ok:
        click.get_current_context().exit(1)


def _print(found: Diagnosis) -> None:
    """Print the findings, not as a table: the lines that mend are to be copied whole."""
    width = max(len(c.name) for c in found.checks if c.group != "main job")
    group = ""
    for check in found.checks:
        if check.group == "main job":
            continue
        if check.group != group:
            group = check.group
            click.secho(group, bold=True)
        state = click.style(f"{check.state:7}", fg=COLOURS[check.state])
        click.echo(f"  {state}  {check.name:{width}}  {check.detail}")
        if check.mend is not None and check.state != "ok":
            click.echo(f"  {'':7}  {'':{width}}  -> {check.mend}")
    click.echo()
    _print_verdict(found)


def _print_verdict(found: Diagnosis) -> None:
    job = next((c for c in found.checks if c.group == "main job"), None)
    name = "sw run" if job is None else job.name
    if found.ok and job is not None:
        click.secho(f"`{name}` works here: {job.detail}", fg="green" if job.mend is None else "yellow")
        if job.mend is not None:
            click.echo(f"  -> {job.mend}")
        return
    click.secho(f"`{name}` cannot run here:", fg="red")
    for check in found.checks:
        if check.needed and check.state != "ok":
            click.echo(f"  {check.name if check is not job else 'it'}: {check.detail}")
            if check.mend is not None:
                click.echo(f"    -> {check.mend}")
