"""`sw data`: scenes on disk."""

from __future__ import annotations

from pathlib import Path

import click

from splatwizard_core.cli.options import assignments, debug_option, json_option, options, print_json, set_option
from splatwizard_core.cli.setup import resolve_run_options, say


@click.group(short_help="scenes on disk")
def data() -> None:
    """Scenes on disk."""


@data.command(short_help="write the procedural demo scene")
@click.argument("out", metavar="OUT")
@options(
    click.option(
        "--size", type=click.Choice(["demo", "tiny"]), default="demo", show_default=True,
        help="demo: 72 views of 256x192 px; tiny: 8 views of 64x48 px.",
    ),
    click.option(
        "--format", "layout", type=click.Choice(["colmap", "blender"]), default="colmap", show_default=True,
        help="Folder layout; colmap keeps the start points, blender the split into train and test views.",
    ),
    click.option("--text", is_flag=True, help="COLMAP model as text.  [default: binary]"),
    set_option, json_option, debug_option,
)  # fmt: skip
def synth(out: str, size: str, layout: str, text: bool, sets: tuple[str, ...], as_json: bool) -> None:
    """Write the procedural demo scene into the folder OUT, as a data set that any trainer reads.

    --set takes scene keys: resolution, test_every, background, split.
    """
    from splatwizard_core.errors import UserInputError
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.scene.loaders import load_scene
    from splatwizard_core.scene.write_scene import write_scene

    target = Path(out)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise UserInputError(f"{out} is not an empty folder: choose another one")
    _, scene_options, _ = resolve_run_options(None, assignments(sets))
    scene = load_scene("demo" if size == "demo" else f"demo:{size}", scene_options, load_plugins())
    say(f"drawing {len(scene.train) + len(scene.test)} views")
    write_scene(scene, target, layout, text=text)
    facts = {
        "folder": out,
        "layout": layout,
        "train_views": len(scene.train),
        "test_views": len(scene.test),
        "points": 0 if scene.points is None else len(scene.points),
        "split": scene.protocol.split,
    }
    if as_json:
        print_json(facts)
    else:
        click.echo(f"{facts['train_views']} train and {facts['test_views']} test views ({layout}): {out}")
