"""`sw render`: pictures of a scene."""

from __future__ import annotations

from pathlib import Path

import click

from splatwizard_core.cli import options as shared
from splatwizard_core.cli.paths import INPUT_FILE, OUTPUT_FOLDER
from splatwizard_core.cli.setup import Choices, open_session, takes_choices
from splatwizard_core.plugins import load_plugins


@click.command(short_help="draw an encoded scene as PNG")
@click.argument("file", metavar="FILE", type=INPUT_FILE)
@shared.options(
    shared.scene_option, shared.images_option, shared.config_option, shared.set_option,
    click.option(
        "--out", default="renders", show_default=True, metavar="DIR", type=OUTPUT_FOLDER,
        help="Folder for the PNG files.",
    ),
    click.option(
        "--views", type=click.Choice(["test", "train", "all"]), default="test", show_default=True,
        help="Which cameras of the scene.",
    ),
    shared.device_option, shared.json_option, shared.debug_option,
)  # fmt: skip
@takes_choices
def render(file: Path, out: Path, views: str, as_json: bool, chosen: Choices) -> None:
    """Draw FILE (.swz or .ply) from the cameras of a scene, as 8-bit PNG."""
    from splatwizard_core.runs.measure import opener, render_views

    resolved = chosen.resolve_without_method()
    session = open_session(resolved, load_plugins())
    opened = opener(file, session)()
    scene = session.scene(resolved)
    wanted = {"test": scene.test, "train": scene.train, "all": [*scene.train, *scene.test]}[views]
    unique = list({view.name: view for view in wanted}.values())
    files = render_views(session, resolved, opened, unique, out)
    shared.print_facts({"folder": str(out), "files": files}, as_json, f"{len(files)} pictures: {out}")
