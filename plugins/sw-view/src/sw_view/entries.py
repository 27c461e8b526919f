"""Models that a viewer can show: files, run directories and folders of these; opened when they are looked at."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from sw_gaussians.baking import bake

from splatwizard_core.api import (
    ContainerReader,
    GaussianModel,
    PluginManager,
    Protocol,
    Scene,
    SceneError,
    SplatModel,
    UserInputError,
)
from splatwizard_core.tooling import Choices, NegotiatedRasterizer, bytes_with_named, open_session, open_subject
from sw_view.coded_file import with_live
from sw_view.drawing import Drawing
from sw_view.packing import Packed, solid_means
from sw_view.page_file import LIVE, MADE_UP, About
from sw_view.shown_cameras import Surroundings, made_up_surroundings, surroundings_about, surroundings_of

ENCODED, CONFIG, INDEX = "scene.swz", "config.toml", "lod-meta.json"
MOST = 200
"""Runs of one folder that are offered."""


@dataclass(frozen=True)
class Entry:
    """A file that can be opened, and the run directory that it is of, if it is of one."""

    label: str
    file: Path
    run: Path | None


@dataclass(frozen=True)
class Opened:
    """An opened model with the places to look at it from; `has_scene`: they are those of its scene."""

    entry: Entry
    drawing: Drawing
    around: Surroundings
    has_scene: bool

    @property
    def told(self) -> str:
        """Counts and bytes in one line."""
        counts = ", ".join(
            f"{n:,} {name.removeprefix('num_')}" for name, n in self.drawing.model.counts().items()
        )  # fmt: skip
        return f"{counts}, {bytes_with_named(self.entry.file):,} bytes"


def find_entries(path: Path) -> list[Entry]:
    """Return what a path offers: the file, the file of a run directory, or of the run directories below a folder.

    Raises UserInputError if that is nothing.
    """
    if path.is_file():
        of_run = path.name == ENCODED and (path.parent / CONFIG).is_file()
        return [Entry(str(path), path, path.parent if of_run else None)]
    if (path / INDEX).is_file():
        return [Entry(str(path), path / INDEX, None)]
    found = [file for file in sorted(path.rglob(ENCODED)) if (file.parent / CONFIG).is_file()][:MOST]
    if not found:
        raise UserInputError(
            f"{path} holds no finished run ({ENCODED} beside {CONFIG}): name a file or a run directory"
        )
    if found == [path / ENCODED]:
        return [Entry(str(path), found[0], path)]
    return [Entry(str(file.parent.relative_to(path)), file, file.parent) for file in found]


def find_all_entries(paths: Iterable[Path]) -> dict[str, Entry]:
    """Return what several paths offer, by label, each file once; of equal labels each becomes the whole path.

    Raises UserInputError if one of them offers nothing.
    """
    found = {entry.file.resolve(): entry for path in paths for entry in find_entries(path)}.values()
    times = Counter(entry.label for entry in found)
    whole = (
        entry if times[entry.label] == 1 else replace(entry, label=str(entry.run or entry.file)) for entry in found
    )
    return {entry.label: entry for entry in whole}


def open_entry(entry: Entry, chosen: Choices, plugins: PluginManager) -> Opened:
    """Open the model of an entry and its scene: that of `chosen`, else of its run, else none.

    Without a scene, cameras are made up around the Gaussians. Raises BitstreamError, PluginError, SceneError,
    UserInputError for a file or a scene that cannot be opened.
    """
    named = chosen.scene is not None or chosen.config_file is not None
    if entry.run is not None and not named:
        chosen = replace(chosen, config_file=str(entry.run / CONFIG))
    resolved = chosen.resolve_without_method()
    session = open_session(resolved, plugins)
    has_scene = named or entry.run is not None
    scene = None
    if not has_scene:
        background = "white" if resolved.scene.background == "white" else "black"
        scene = Scene(entry.file.stem, [], [], None, Protocol("none", background=background))
    found = open_subject(entry.file, session, resolved, scene)
    rasterizer = found.rasterizer
    assert isinstance(rasterizer, NegotiatedRasterizer)  # a session has no other
    drawing = Drawing(found.model, found.scene, rasterizer, found.options, session.device)
    around = surroundings_of(found.scene) if has_scene else _about(drawing)
    return Opened(entry, drawing, around, has_scene)


def for_page(opened: Opened) -> tuple[SplatModel | Packed, str]:
    """Return a model for a page, and a sentence about its Gaussians and cameras.

    Gaussians that depend on the camera are computed in the page, where it has a decoder of the file; else fitted at the
    training cameras of the scene, if there is one.
    """
    drawing = opened.drawing
    live = with_live(drawing.model, opened.entry.file, [each.camera for each in opened.around.cameras])
    if live is not None:
        return live, LIVE if opened.has_scene else f"{LIVE} {MADE_UP}"
    if isinstance(drawing.model, GaussianModel) or not opened.has_scene:
        return drawing.model, "" if opened.has_scene else MADE_UP
    cameras = [view.camera for view in drawing.scene.train]
    baked = bake(drawing.model, cameras, drawing.rasterizer, drawing.options)
    return baked, f"The method's Gaussians depend on the camera; these were fitted at {len(cameras)} training cameras."


def about_page(opened: Opened) -> About:
    """Return the facts that the HTML page of an opened model tells."""
    file, drawing = opened.entry.file, opened.drawing
    encoded = file.suffix == ".swz"
    options = drawing.rasterizer.decided(drawing.options)
    red, green, blue = drawing.scene.background.tolist()
    return About(
        drawing.scene.name, ContainerReader.open(file).method if encoded else None, bytes_with_named(file),
        (red, green, blue), options.eps2d, options.antialias,
    )  # fmt: skip


def _about(drawing: Drawing) -> Surroundings:
    """Return cameras around a model without a scene: around its Gaussians, else around its anchors."""
    model = drawing.model
    if isinstance(model, GaussianModel):
        try:
            return made_up_surroundings(model, drawing.rasterizer)
        except SceneError:  # no such camera shows anything: there may be something that can be drawn all the same
            return surroundings_about(solid_means(model))
    return surroundings_about(getattr(model, model.ROWS[0]).detach().float().cpu().numpy()[:, :3])
