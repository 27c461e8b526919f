"""`sw render`: pictures of a scene, and maps of what is seen in them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from splatwizard_core.tooling import (
    EXISTING,
    OUTPUT_FILE,
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
from sw_view.modes import AUTO, DEPTHS, NORMALS, PATHS


def _modes(_context: click.Context, _parameter: click.Parameter, value: str | None) -> tuple[str, ...]:
    words = [word.strip() for word in value.split(",")] if value is not None else []
    for word in words:
        if word not in DEPTHS:
            swallowed = " (FILE goes before it)" if Path(word).exists() and word else ""
            raise click.UsageError(f"--depth has no mode '{word}': one or more of {', '.join(DEPTHS)}{swallowed}")
    return tuple(dict.fromkeys(words))


def _size(_context: click.Context, _parameter: click.Parameter, value: str | None) -> tuple[int, int] | None:
    if value is None:
        return None
    sides = value.lower().split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() and 16 <= int(side) <= 16_384 for side in sides):
        raise click.UsageError(f"--size '{value}' is no size: WIDTHxHEIGHT in pixels, 16 to 16384, such as 1280x720")
    return int(sides[0]), int(sides[1])


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
        "--trajectory", metavar="PATH", shell_complete=_offered(PATHS),
        help=f"Cameras on a path in place of the views: {', '.join(PATHS)} (by the training cameras), or a JSON file.  "
        "[default: the views]",
    ),
    click.option(
        "--video", type=OUTPUT_FILE, metavar="FILE",
        help="Write the frames as one video (.mp4, .webm, .mkv, .mov), maps beside it; needs av.  [default: PNGs]",
    ),
    click.option("--frames", type=click.IntRange(1, 100_000), metavar="N", help="Cameras on the path.  [default: 120]"),
    click.option(
        "--fps", type=click.FloatRange(1e-3, 1000), metavar="F", help="Frames a second.  [default: 30]"
    ),
    click.option(
        "--size", callback=_size, metavar="WxH", shell_complete=_offered(("960x540", "1280x720", "1920x1080")),
        help="Of the frames, pixels.  [default: that of the first camera]"
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
    trajectory: str | None,
    video: Path | None,
    frames: int | None,
    fps: float | None,
    size: tuple[int, int] | None,
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

    FILE is a .swz, a .ply, or a run directory: then its scene.swz. Without --scene the scene is that of the run
    directory, or of the one that the file lies in. Any method can be drawn with depth; only surfels have normals of
    their own. With --trajectory the cameras move, and --video makes one file of the frames. What the arrays hold, and
    the JSON of cameras, is in the README of sw-view.
    """
    from sw_view.drawing import encoded_file, open_drawing
    from sw_view.exr import exr_library
    from sw_view.films import draw_films
    from sw_view.map_files import MapFiles
    from sw_view.maps import MapRequest
    from sw_view.trajectory import even, make_trajectory
    from sw_view.video import check_video
    from sw_view.views import draw_views

    if normals not in (None, AUTO, *NORMALS):
        raise click.UsageError(f"--normals has no kind '{normals}': {' or '.join(NORMALS)}")
    if (depth_png or depth_exr or depth_scale is not None) and (not depths or video is not None):
        other = "leave out --video" if depths else "add --depth"
        raise click.UsageError(f"--depth-png, --depth-exr and --depth-scale say how --depth is written: {other}")
    if trajectory is None and (video is not None or frames is not None or size is not None):
        raise click.UsageError(f"--video, --frames and --size are for --trajectory: {', '.join(PATHS)} or a JSON file")
    if trajectory is not None and trajectory not in PATHS and not Path(trajectory).is_file():
        raise click.UsageError(f"--trajectory '{trajectory}' is none of {', '.join(PATHS)}, and no file")
    if fps is not None and video is None:
        raise click.UsageError("--fps is for --video: add that")
    if depth_exr:
        exr_library()
    if video is not None:
        check_video(video)
    if file.is_dir():
        chosen = replace(chosen, config_file=chosen.config_file or str(file / "config.toml"))
        file = encoded_file(file)
    resolved = chosen.of_file(file).resolve_without_method()
    drawing = open_drawing(file, open_session(resolved, load_plugins()), resolved)
    if trajectory is None:
        path, drawn = None, drawing.views(views)
    else:
        path = make_trajectory(drawing, trajectory, frames=frames, fps=fps, size=size, fit=even if video else None)
        drawn = path.views
    request = MapRequest(depths, normals, alpha, drawing.depth_ratio if depth_ratio is None else depth_ratio)
    if drawn and not request.is_empty:
        request = request.suited(surfels=drawing.has_surfels(drawn[0].camera), what=file.name)
    facts: dict[str, Any]
    if video is not None and path is not None:
        written = draw_films(drawing, path, video, request)
        facts = {"files": [str(each) for each in written], "frames": len(drawn), "fps": path.fps}
        told = f"{len(drawn)} frames, {len(drawn) / path.fps:.1f} s: {', '.join(facts['files'])}"
    else:
        maps = MapFiles(out, request, png=depth_png or depth_scale is not None, exr=depth_exr, scale=depth_scale)
        files = draw_views(drawing, drawn, out, maps)
        facts = {"folder": str(out), "files": files, **({} if request.is_empty else {"maps": maps.written})}
        told = f"{', '.join([f'{len(files)} pictures', *maps.written])}: {out}"
    if not request.is_empty:
        facts |= {"normals": request.normals, "rasterizers": drawing.rasterizer.choices}
    print_facts(facts, as_json, told)
