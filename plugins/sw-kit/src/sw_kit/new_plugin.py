"""`sw new-plugin`: write a package that works, to be changed from there."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from splatwizard_core.tooling import OUTPUT_FOLDER, debug_option, json_option, options, print_json
from sw_kit.templates import commands, kinds, rendered

if TYPE_CHECKING:
    from sw_kit.names import Names
    from sw_kit.templates import Kind


@click.command("new-plugin", short_help="start a package: a method, a codec, a metric, ...")
@click.argument("name", metavar="NAME")
@click.option("--kind", type=click.Choice(list(kinds())), default="method", show_default=True,
              help="What the package provides.")  # fmt: skip
@click.option("--into", default=".", show_default=True, metavar="DIR", type=OUTPUT_FOLDER,
              help="Folder in which the package's own folder, sw-NAME, is made.")  # fmt: skip
@options(json_option, debug_option)
def new_plugin(name: str, kind: str, into: Path, as_json: bool) -> None:
    """Write the package sw-NAME: it can be installed, used and published as it is, and is yours to change.

    It has a pyproject.toml, README, licence, tests and a workflow for CI. A method has typed hyper-parameters, presets,
    rate points, and a file that refuses what is damaged. A NAME that is taken here is refused, and so is a folder that
    exists.
    """
    from splatwizard_core.api import UserInputError
    from splatwizard_core.tooling import load_plugins
    from sw_kit.names import check_free, legal_names

    chosen, names = kinds()[kind], legal_names(name)
    check_free(names, chosen.registers, load_plugins())
    target = into / names.distribution
    if target.exists():
        raise UserInputError(f"{target} exists already: remove it, or choose another --into or NAME")
    written = write(target, chosen, names)
    install = f"pip install -e '{target}[test]'"
    if as_json:
        print_json({
            "kind": kind, "name": names.key, "distribution": names.distribution, "package": names.package,
            "folder": str(target), "files": written, "next": [install, *commands(chosen, names)],
        })  # fmt: skip
        return
    click.echo(f"wrote {target}, {len(written)} files:")
    for path in written:
        click.echo(f"  {path}")
    click.echo("next:")
    for line in (install, *commands(chosen, names), f"sw check-plugin {names.distribution}"):
        click.echo(f"  {line}")


def write(target: Path, kind: Kind, names: Names) -> list[str]:
    """Write the package into the new folder `target`, whole or not at all; returns the paths below it."""
    from splatwizard_core.tooling import new_folder

    found = rendered(kind, names)
    with new_folder(target) as folder:
        for path, text in found.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_text(text, encoding="utf-8")
    return list(found)
