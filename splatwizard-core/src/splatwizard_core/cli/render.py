"""`sw render`: pictures of a scene."""

from __future__ import annotations

from pathlib import Path

import click

from splatwizard_core.cli import complete
from splatwizard_core.cli.options import (
    assignments,
    config_option,
    debug_option,
    device_option,
    images_option,
    json_option,
    options,
    print_json,
    scene_option,
    set_option,
)
from splatwizard_core.cli.setup import existing_file, open_session, output_folder, resolve_run_options


@click.command(short_help="draw an encoded scene as PNG")
@click.argument("file", metavar="FILE", shell_complete=complete.files)
@options(
    scene_option, images_option, config_option, set_option,
    click.option(
        "--out", default="renders", show_default=True, metavar="DIR", shell_complete=complete.folders,
        help="Folder for the PNG files.",
    ),
    click.option(
        "--views", type=click.Choice(["test", "train", "all"]), default="test", show_default=True,
        help="Which cameras of the scene.",
    ),
    device_option, json_option, debug_option,
)  # fmt: skip
def render(
    file: str,
    scene: str | None,
    images: str | None,
    config_file: str | None,
    sets: tuple[str, ...],
    out: str,
    views: str,
    device: str | None,
    as_json: bool,
) -> None:
    """Draw FILE (.swz or .ply) from the cameras of a scene, as 8-bit PNG."""
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.runs.measure import opener, render_views
    from splatwizard_core.scene.loading import load_scene

    path = existing_file(file)
    plugins = load_plugins()
    ppl, scene_options, said_scene = resolve_run_options(config_file, assignments(sets, images=images, device=device))
    session = open_session(ppl, plugins)
    opened = opener(path, plugins, session.device)()
    output_folder(out)  # only now: a file that cannot be opened leaves no empty folder
    loaded = load_scene(scene or said_scene or "demo", scene_options, plugins)
    chosen = {"test": loaded.test, "train": loaded.train, "all": [*loaded.train, *loaded.test]}[views]
    unique = list({view.name: view for view in chosen}.values())
    files = render_views(opened, unique, loaded.background, plugins, session.device, ppl, Path(out))
    if as_json:
        print_json({"folder": out, "files": files})
    else:
        click.echo(f"{len(files)} pictures: {out}")
