"""`sw compare`: two files of any format beside each other, or what was measured beside what was published."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from splatwizard_core.tooling import (
    EXISTING,
    Choices,
    debug_option,
    device_option,
    images_option,
    json_option,
    name_of,
    options,
    print_facts,
    scene_option,
    set_option,
    takes_choices,
)

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, View
    from sw_report.compared_models import OpenedFile

MADE_UP = 12
"""Pictures where neither a scene nor cameras are given."""
VIDEO_METRICS = ("cvvdp", "vmaf")
"""Names of `sw_report.path_video`, which completion does not import: it would load torch."""


def _video_words(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
    return [name for name in VIDEO_METRICS if name.startswith(incomplete)]


@click.command(short_help="two files; a run beside published figures")
@click.argument("paths", metavar="A B | RUN...", nargs=-1, required=True, type=EXISTING)
@options(
    scene_option, images_option, set_option,
    click.option(
        "--cameras", type=EXISTING, metavar="FILE",
        help="JSON of the cameras to draw from (README of sw-view).  [default: the scene's test views; without a "
        "scene 12 that are made up]",
    ),
    click.option(
        "--metrics", metavar="NAME[,NAME]", type=name_of("metric"),
        help="Metrics of pictures that B's are measured by against A's, such as ssim,flip.  [default: PSNR alone]",
    ),
    click.option(
        "--path", "is_path", is_flag=True,
        help="The cameras of --cameras are the frames of a path with a fixed step: tell of flicker and popping too.",
    ),
    click.option(
        "--path-metrics", metavar="NAME[,NAME]", shell_complete=_video_words,
        help="Models of vision of the path as a video, slow: cvvdp (sw-metrics[cvvdp]), vmaf (an ffmpeg with "
        "libvmaf).  [default: none]",
    ),
    click.option("--published", is_flag=True, help="Compare runs with published figures of their data set and scene."),
    click.option("--own", is_flag=True, help="Published figures of the measured methods alone."),
    device_option, json_option, debug_option,
)  # fmt: skip
@takes_choices
def compare(
    paths: tuple[Path, ...],
    cameras: Path | None,
    metrics: str | None,
    is_path: bool,
    path_metrics: str | None,
    published: bool,
    own: bool,
    as_json: bool,
    chosen: Choices,
) -> None:
    """Compare two files of any format or method, or run directories: bytes, attributes, and what they show.

    Errors of attributes are those of B, of explicit Gaussians; rows are matched in order, or each with the nearest mean
    where the order differs. The PSNR is that of B's pictures against A's, as each file asks to be drawn;
    on a scene (--scene, or that of a run directory) also of both against the test pictures.

    With --published every run under RUN... is put beside published figures, scene by scene, and means over whole data
    sets. Each figure is told with its source and year, and with what differs between its protocol and the run's. At
    equal PSNR stands the size of the rate points that were run, where they reach it. Figures that were not re-read at
    their source are marked.
    """
    if published:
        _beside_published(paths, own, as_json)
        return
    if len(paths) != 2:
        raise click.UsageError("give two files (or run directories) A and B, or --published with any number of runs")
    if own:
        raise click.UsageError("--own is for --published")
    if is_path and cameras is None:
        raise click.UsageError("--path is for --cameras FILE")
    asked = _Asked(_names(metrics), is_path, _video_metrics(path_metrics, is_path))
    print_facts(_compared(paths[0], paths[1], cameras, chosen, asked), as_json, _tell)


def _beside_published(folders: tuple[Path, ...], own: bool, as_json: bool) -> None:
    from sw_report.printed import print_tables
    from sw_report.published_tables import published_tables, to_dict
    from sw_report.runs import collect

    collection = collect(folders)
    tables = published_tables(collection.runs, others=not own)

    def told(facts: dict[str, Any]) -> None:
        print_tables([(table.title, table.drawn()) for table in tables], facts["notes"])

    print_facts({"tables": [to_dict(table) for table in tables], "notes": collection.notes}, as_json, told)


@dataclass(frozen=True)
class _Asked:
    """Wishes about the pictures besides PSNR: metrics by name, whether they are a path, and metrics of its video."""

    metrics: tuple[str, ...]
    is_path: bool
    video: tuple[str, ...]


def _names(text: str | None) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name.strip() for name in (text or "").split(",") if name.strip()))


def _video_metrics(text: str | None, is_path: bool) -> tuple[str, ...]:
    """Names of --path-metrics. Raises click.UsageError for others, and without --path."""
    names = _names(text)
    if unknown := [name for name in names if name not in VIDEO_METRICS]:
        raise click.UsageError(f"--path-metrics {unknown[0]}: give some of {', '.join(VIDEO_METRICS)}")
    if text is not None and not (is_path and names):
        raise click.UsageError(f"--path-metrics is for --path, with some of {', '.join(VIDEO_METRICS)}")
    return names


def _compared(a: Path, b: Path, camera_file: Path | None, chosen: Choices, asked: _Asked) -> dict[str, Any]:
    from splatwizard_core.api import GaussianModel, UserInputError
    from splatwizard_core.tooling import load_plugins, open_session
    from sw_report.attribute_errors import attribute_errors
    from sw_report.compared_metrics import PictureMetrics
    from sw_report.compared_models import compare_pictures, open_file
    from sw_report.path_video import PathVideo

    configs = [path / "config.toml" for path in (a, b) if (path / "config.toml").is_file()]
    of_runs = [replace(chosen, config_file=str(config)).resolve_without_method() for config in configs]
    scenes = sorted({each.absolute_scene for each in of_runs})
    if len(scenes) > 1 and camera_file is None:
        raise UserInputError(
            f"the runs are of different scenes, {' and '.join(scenes)}, so they have no views in common: give --scene "
            "SCENE if they are one scene by two names, else --cameras FILE"
        )
    resolved = of_runs[0] if of_runs else chosen.resolve_without_method()
    session = open_session(resolved, load_plugins())
    scene = session.scene(resolved) if chosen.scene is not None or configs else None
    metrics = PictureMetrics(asked.metrics, session.plugins, session.device, resolved.metrics)
    left, right = (open_file(path, session, resolved, scene) for path in (a, b))
    test = [] if scene is None or camera_file is not None else scene.test
    places, seen_from = [view.camera for view in test], f"test views of {scene.name}" if scene is not None else ""
    if not test:
        places, seen_from = _places(camera_file, left, right)
    errors = None
    explicit = isinstance(left.model, GaussianModel) and isinstance(right.model, GaussianModel)
    if isinstance(left.model, GaussianModel) and isinstance(right.model, GaussianModel):
        errors = attribute_errors(left.model, right.model)
    reason = None if errors else "no finite Gaussians" if explicit else "the Gaussians depend on the camera"
    video = PathVideo(asked.video, session.plugins, resolved.metrics) if asked.video else None
    pictures = compare_pictures(
        left, right, places, _with_pictures(test), is_path=asked.is_path, video=video, metrics=metrics
    )
    return {
        "a": left.facts(),
        "b": right.facts(),
        "attributes": errors and errors.as_dict(),
        "no_attributes": reason,
        "cameras": seen_from,
        "psnr": pictures,
        "metrics": metrics.result(),
    }


def _places(camera_file: Path | None, left: OpenedFile, right: OpenedFile) -> tuple[list[Camera], str]:
    """Cameras of a file, or made up for whichever model is explicit, A first; and what they are called."""
    from sw_gaussians.camera_files import read_cameras
    from sw_gaussians.made_up_cameras import plausible_cameras

    from splatwizard_core.api import GaussianModel, UserInputError

    if camera_file is not None:
        return read_cameras(camera_file).cameras, str(camera_file)
    for each in (left, right):
        if isinstance(each.model, GaussianModel):  # by those held out: B may have been made for the others
            made = plausible_cameras(each.model, each.rasterizer, fit=1, held_out=MADE_UP)
            return made.held_out, f"made up, {made.recipe}"
    raise UserInputError("the Gaussians of both depend on the camera: give --scene SCENE or --cameras FILE")


def _with_pictures(views: list[View]) -> list[View] | None:
    return views if views and all(view.load is not None for view in views) else None


def _told_of_video(found: dict[str, Any]) -> list[str]:
    lines = [f"{name} of the video: {found[name]:.2f} ({made})" for name, made in found.get("made_with", {}).items()]
    return lines + [f"{name} is not available: {why}" for name, why in found.get("not_available", {}).items()]


def _tell(facts: dict[str, Any]) -> None:
    from splatwizard_core.tooling import print_table

    a, b, psnr, attributes = facts["a"], facts["b"], facts["psnr"], facts["attributes"]
    rows = [["file", a["file"], b["file"]], ["format or method", a["kind"], b["kind"]]]
    rows.append(["bytes", f"{a['bytes']:,}", f"{b['bytes']:,} ({b['bytes'] / max(a['bytes'], 1):.3g} x)"])
    for name in sorted({*a["counts"], *b["counts"]}):
        rows.append([name.removeprefix("num_"), *(f"{each['counts'].get(name, 0):,}" for each in (a, b))])
    if "a_to_pictures" in psnr:
        rows.append(["PSNR, dB", f"{psnr['a_to_pictures']:.2f}", f"{psnr['b_to_pictures']:.2f}"])
    print_table(["", "A", "B"], rows)
    seen = f"{psnr['views']} cameras ({facts['cameras']})"
    click.echo(f"B against A: {psnr['mean']:.2f} dB, at least {psnr['least']:.2f} dB, from {seen}")
    for name, found in facts["metrics"].items():
        value = "not available: " + found.get("reason", "") if found["mean"] is None else f"{found['mean']:.4f}"
        click.echo(f"{name} of B against A: {value}")
    if "path" in psnr:
        path = psnr["path"]
        told = {name: "-" if value is None else f"{value:.3g}" for name, value in path.items() if name != "video"}
        click.echo(
            f"along the path, {told['frames']} frames: flicker {told['flicker']} levels (of first differences "
            f"{told['flicker1']}), PSNR {told['psnr']} dB, popping {told['popping_a']} of A, {told['popping_b']} of B"
        )
        for line in _told_of_video(path.get("video", {})):
            click.echo(line)
    if attributes is None:
        click.echo(f"no errors of attributes: {facts['no_attributes']}")
        return
    kinds = {"rms": "RMS", "median": "median", "q99": "99 % below", "max": "largest"}
    errors = [
        [name.replace("_", " "), *(f"{e[kind]:.3g}" for kind in kinds)] for name, e in attributes["errors"].items()
    ]
    how = "in order" if attributes["matched"] == "in order" else "with the nearest mean"
    click.echo(f"errors of {attributes['rows']:,} Gaussians, matched {how}:")
    print_table(["", *kinds.values()], errors, right=len(kinds))
    if attributes["taken_twice"] or attributes["never_taken"] or any(attributes["left_out"]):
        left_out = " and ".join(f"{n:,}" for n in attributes["left_out"])
        twice, never = attributes["taken_twice"], attributes["never_taken"]
        click.echo(f"of B {twice:,} were taken more than once, {never:,} never; not finite: {left_out}")
