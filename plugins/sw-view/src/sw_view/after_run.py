"""The page scene.html in the directory of a finished run; report.html has a link to it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch

from splatwizard_core.api import GaussianModel
from splatwizard_core.tooling import FinishedRun, ForeseenError, load_plugins, open_model
from sw_view.page_file import FILE_NAME, About, write_page
from sw_view.shown_cameras import surroundings_of

MOST = 200_000
"""Gaussians: a page of more has over 10 MB, and is written where somebody asks for it (`sw view RUN --html`)."""
LONGEST_DECODE = 5.0
"""Seconds that a file may have taken to decode for being decoded once more, for the page alone."""


def show_finished(run: FinishedRun, tell: Callable[[str], None]) -> None:
    """Write the page of a run, unless it is there and newer than its file.

    None is written for models whose Gaussians depend on the camera, for large ones, and for slow decoders. A page that
    cannot be made is told in one line: it never makes a finished run fail.
    """
    file, page = run.directory / "scene.swz", run.directory / FILE_NAME
    counts, decode_s = run.record.counts, run.record.codec.decode_s
    small = set(counts) == {"num_gaussians"} and 0 < counts["num_gaussians"] <= MOST
    if not small or decode_s > LONGEST_DECODE or _is_newer(page, file):
        return
    try:
        _write(run, file, page)
    except Exception as error:
        why = str(error) if isinstance(error, (ForeseenError, OSError)) else f"{type(error).__name__}: {error}"
        tell(f"warning: {page} was not written: {why} (the results are whole; `sw view RUN --html` makes it, too)")


def _write(run: FinishedRun, file: Path, page: Path) -> None:
    model, reader = open_model(file, load_plugins(), torch.device("cpu"))
    if not isinstance(model, GaussianModel):
        return
    scene, raster = run.open_scene(), reader.raster
    red, green, blue = scene.background.tolist()
    title = f"{reader.method} {run.directory.name} on {scene.name}"
    about = About(
        title, reader.method, reader.size, (red, green, blue), float(raster.get("eps2d", 0.3)),
        bool(raster.get("antialias", False)),
    )  # fmt: skip
    write_page(model, page, about, surroundings_of(scene))


def _is_newer(page: Path, file: Path) -> bool:
    return page.exists() and page.stat().st_mtime_ns >= file.stat().st_mtime_ns
