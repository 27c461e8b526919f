"""`sw check-plugin`: hold installed packages to the contracts, one line a check."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import click

from splatwizard_core.tooling import debug_option, json_option, options, print_json, set_option

if TYPE_CHECKING:
    from splatwizard_core.tooling import Check
    from sw_kit.finding import PackageCheck


COLOURS = {"ok": "green", "missing": "yellow", "broken": "red"}


def _installed(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete the name of an installed distribution with plugins."""
    from splatwizard_core.tooling import load_plugins

    return [info.distribution for info in load_plugins().plugins if info.distribution.startswith(incomplete)]


@click.command("check-plugin", short_help="hold a package to the contracts")
@click.argument("distributions", metavar="[DIST]...", nargs=-1, shell_complete=_installed)
@click.option("--quick", is_flag=True, help="Only what takes no run: registration, fields, signatures, presets.")
@options(set_option, json_option, debug_option)
def check_plugin(distributions: tuple[str, ...], quick: bool, sets: tuple[str, ...], as_json: bool) -> None:
    """Check installed packages, DIST by DIST, or all plugins that are installed: one line a check, and what to do.

    A package is held to light registration, legal fields, declared requirements, and the signatures of its contracts.
    Without --quick what it provides is used: a method trains some steps on a tiny scene, stops and resumes, encodes,
    and decodes in a fresh process and from damaged files; --set goes to those runs. Exit status 1 if a check fails.
    """
    from splatwizard_core.tooling import load_plugins
    from sw_kit.suite import checks_of

    names = list(distributions) or [info.distribution for info in load_plugins().plugins if info.key != "core"]
    checks = [check for name in names for check in checks_of(name, quick=quick, settings=sets)]
    found: list[tuple[Check, float]] = []
    for check in checks:
        finding, seconds = _made(check)
        if not as_json:
            _print(finding, seconds, first=not found or found[-1][0].group != finding.group)
        found.append((finding, seconds))
    broken = sum(finding.state == "broken" for finding, _ in found)
    if as_json:
        print_json({
            "ok": not broken,
            "checks": [{**finding.as_dict(), "seconds": round(seconds, 3)} for finding, seconds in found],
        })  # fmt: skip
    else:
        click.echo(f"\n{len(found)} checks, {broken} broken, {sum(seconds for _, seconds in found):.1f} s")
    if broken:
        click.get_current_context().exit(1)


def _made(check: PackageCheck) -> tuple[Check, float]:
    """Make one check; return its finding and its seconds."""
    began = time.perf_counter()
    finding = check.finding()
    return finding, time.perf_counter() - began


def _print(finding: Check, seconds: float, *, first: bool) -> None:
    """Print a line, and below it the one that mends what is not ok; not as a table: it is to be copied whole."""
    if first:
        click.secho(finding.group, bold=True)
    state = click.style(f"{finding.state:7}", fg=COLOURS[finding.state])
    click.echo(f"  {state}  {finding.name}: {finding.detail} ({seconds:.1f} s)")
    if finding.mend is not None and finding.state != "ok":
        click.echo(f"  {'':7}  -> {finding.mend}")
