"""`sw render`: pictures of a scene, and maps of what is seen in them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import (
    EXISTING,
    OUTPUT_FOLDER,
    Choices,
    config_option,
    debug_option,
    device_option,
    images_option,
    json_option,
    load_plugins,
    open_session,
    options,
    print_facts,
    scene_option,
    set_option,
    takes_choices,
)
from sw_render.modes import AUTO, DEPTHS, NORMALS


def _modes(_context: click.Context, _parameter: click.Parameter, value: str | None) -> tuple[str, ...]:
    words = [word.strip() for word in value.split(",")] if value is not None else []
    for word in words:
        if word not in DEPTHS:
            swallowed = " (FILE goes before it)" if Path(word).exists() and word else ""
            raise click.UsageError(f"--depth has no mode '{word}': one or more of {', '.join(DEPTHS)}{swallowed}")
    return tuple(dict.fromkeys(words))


def _offered(names: Iterable[str]) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    """Complete a word on the command line to one of these names."""
    return lambda _context, _parameter, incomplete: [name for name in names if name.startswith(incomplete)]


@click.command(short_help="draw an encoded scene: pictures, depth, normals")
@click.argument("file", metavar="FILE", type=EXISTING)
@options(
    scene_option, images_option, config_option, set_option,
    click.option(
        "--out", default="renders", show_default=True, metavar="DIR", type=OUTPUT_FOLDER,
        help="Folder for the PNG files; maps go to folders in it.",
    ),
    click.option(
        "--views", type=click.Choice(["test", "train", "all"]), default="test", show_default=True,
        help="Which cameras of the scene.",
    ),
    click.option(
        "--depth", "depths", is_flag=False, flag_value="expected", metavar="[MODE[,MODE]]", callback=_modes,
        shell_complete=_offered(DEPTHS),
        help=f"Depth maps in the units of the scene, depth_MODE/NAME.npz: {', '.join(DEPTHS)} (of surfels).  "
        "[default: none; without MODE: expected]",
    ),
    click.option(
        "--normals", is_flag=False, flag_value=AUTO, metavar="[KIND]", shell_complete=_offered(NORMALS),
        help="Normals, normals/NAME.npz and .png: rendered (of surfels), or surface (of the depth).  [default: none; "
        "without KIND: rendered if there are surfels]",
    ),
    click.option("--alpha", is_flag=True, help="Alpha maps, alpha/NAME.png."),
    click.option("--depth-png", is_flag=True, help="Depth also as 16-bit PNG, with its scale in depth.json."),
    click.option("--depth-exr", is_flag=True, help="Depth also as EXR, one channel Z (needs OpenEXR)."),
    click.option(
        "--depth-scale", type=click.FloatRange(min=0, min_open=True), metavar="S",
        help="PNG value of a depth of 1, such as 1000.  [default: the largest depth becomes 65535]",
    ),
    click.option(
        "--depth-ratio", type=click.FloatRange(0, 1), metavar="R",
        help="Share of the median in the depth of a surface.  [default: that of its training, else 0]",
    ),
    device_option, json_option, debug_option,
)  # fmt: skip
@takes_choices
def render(
    file: Path,
    out: Path,
    views: str,
    depths: tuple[str, ...],
    normals: str | None,
    alpha: bool,
    depth_png: bool,
    depth_exr: bool,
    depth_scale: float | None,
    depth_ratio: float | None,
    as_json: bool,
    chosen: Choices,
) -> None:
    """Draw FILE from the cameras of a scene, as 8-bit PNG; with --depth, --normals, --alpha also maps.

    FILE is a .swz, a .ply, or a run directory: then its scene.swz, on its own scene. Any method can be drawn with
    depth; only surfels have normals of their own. What the arrays hold is in the README of sw-render.
    """
    from sw_render.drawing import open_drawing
    from sw_render.exr import exr_library
    from sw_render.map_files import MapFiles
    from sw_render.maps import MapRequest
    from sw_render.views import draw_views

    if normals not in (None, AUTO, *NORMALS):
        raise click.UsageError(f"--normals has no kind '{normals}': {' or '.join(NORMALS)}")
    if (depth_png or depth_exr or depth_scale is not None) and not depths:
        raise click.UsageError("--depth-png, --depth-exr and --depth-scale say how --depth is written: add --depth")
    if depth_exr:
        exr_library()
    if file.is_dir():
        chosen = replace(chosen, config_file=chosen.config_file or str(file / "config.toml"))
        file = _encoded(file)
    resolved = chosen.resolve_without_method()
    drawing = open_drawing(file, open_session(resolved, load_plugins()), resolved)
    scene = drawing.scene
    wanted = {"test": scene.test, "train": scene.train, "all": [*scene.train, *scene.test]}[views]
    unique = list({view.name: view for view in wanted}.values())
    request = MapRequest(depths, normals, alpha, drawing.depth_ratio if depth_ratio is None else depth_ratio)
    if unique and not request.is_empty:
        request = request.suited(surfels=drawing.has_surfels(unique[0].camera), what=file.name)
    maps = MapFiles(out, request, png=depth_png or depth_scale is not None, exr=depth_exr, scale=depth_scale)
    files = draw_views(drawing, unique, out, maps)
    facts: dict[str, Any] = {"folder": str(out), "files": files}
    if not request.is_empty:
        facts |= {"maps": maps.written, "normals": request.normals, "rasterizers": drawing.rasterizer.choices}
    told = ", ".join([f"{len(files)} pictures", *maps.written])
    print_facts(facts, as_json, f"{told}: {out}")


def _encoded(directory: Path) -> Path:
    """The file of a run directory. Raises UserInputError."""
    found = directory / "scene.swz"
    if not found.is_file() or not (directory / "config.toml").is_file():
        raise UserInputError(
            f"{directory} is no finished run directory, it has no scene.swz and config.toml: name a file"
        )
    return found
