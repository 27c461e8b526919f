"""Ground truth beside a render: the photograph that the run kept, else the scene's, if the scene is still there.

A run keeps the photographs of the few views that its page shows, so that its directory makes a page on any machine.
Whatever the source, a photograph is shown only if the render scores against it what the record says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatwizard_core.tooling import ForeseenError
from sw_report.facts import RunFacts, clean
from sw_report.runs import Run

if TYPE_CHECKING:
    from splatwizard_core.api import Scene, View

Pixels = NDArray[np.uint8]  # [H,W,3]
SceneOpener = Callable[[Run], "Scene"]

FOLDER = "truth"
RENDERS = "renders"
EVEN_VIEWS = 4
# Renders and composites of pictures with alpha are rounded to 8 bit in files: up to twice 1/(12 x 255^2) of MSE each.
ROUNDING_MSE = 4 / (12 * 255**2)
SCORE_TOLERANCE = 0.01  # of the MSE
LARGEST_PICTURE = 64_000_000  # pixels


def even_views(views: int, wanted: int = EVEN_VIEWS) -> list[int]:
    """Indices of at most `wanted` of `views`, spread evenly: the same for all runs of a scene."""
    return sorted({min(int((i + 0.5) * views / wanted), views - 1) for i in range(wanted)}) if views else []


def shown_views(facts: RunFacts) -> list[int]:
    """Indices of the views that a run's own page shows: a few spread evenly, the lowest and the highest PSNR."""
    chosen = even_views(len(facts.views))
    scores = facts.metrics["psnr"].per_view if "psnr" in facts.metrics else []
    known = [i for i, value in enumerate(scores[: len(facts.views)]) if value is not None]
    if known:
        chosen += [min(known, key=lambda i: scores[i] or 0.0), max(known, key=lambda i: scores[i] or 0.0)]
    return sorted(set(chosen))


def keep_truth(directory: Path, facts: RunFacts, scene: Scene) -> None:
    """Write the photographs that the page of a run shows into its directory; those that are there stay."""
    names = picture_names(facts.views)
    by_name = {view.name: view for view in scene.test}
    folder = directory / FOLDER
    folder.mkdir(exist_ok=True)
    for i in shown_views(facts):
        view = by_name.get(facts.views[i])
        if view is not None and not (folder / names[i]).exists():
            _save(truth_pixels(view, scene), folder / names[i])


def truth_pixels(view: View, scene: Scene) -> Pixels:
    """A photograph as it is evaluated, rounded to 8 bit."""
    image = view.image(scene.background)
    pixels: Pixels = (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    return pixels


def picture_names(views: Sequence[str]) -> list[str]:
    """File names of the renders of views; imported late, since it comes with torch."""
    from splatwizard_core.tooling import png_names

    return png_names(views)


class Truth:
    """Ground truth of the runs of one scene and protocol.

    runs    whose directories may hold it
    opener  (run) -> its scene; None: scenes are not looked for
    """

    def __init__(self, runs: Sequence[Run], opener: SceneOpener | None) -> None:
        self._runs = runs
        self._opener = opener
        self._scene: Scene | None = None
        self.reason = ""

    def find(self, view: str) -> Pixels | None:
        """Return the photograph of a view, or None, and then `reason` says why."""
        for run in self._runs:
            if view in run.facts.views:
                kept = run.directory / FOLDER / picture_names(run.facts.views)[run.facts.views.index(view)]
                if kept.is_file():
                    try:
                        return read_png(kept)
                    except (OSError, ValueError) as error:
                        self.reason = f"the picture that the run kept cannot be read ({clean(str(error))})"
        scene = self._open()
        if scene is None:
            return None
        for candidate in scene.test:
            if candidate.name == view:
                try:
                    return truth_pixels(candidate, scene)
                except (ForeseenError, OSError, ValueError) as error:
                    self.reason = clean(str(error))
                    return None
        self.reason = f"the scene has no test view {view}"
        return None

    def _open(self) -> Scene | None:
        if self._scene is not None or self._opener is None:
            self.reason = self.reason or "the run kept none"
            return self._scene
        opener, self._opener = self._opener, None  # asked once
        for run in self._runs[:1]:
            try:
                self._scene = opener(run)
            except (ForeseenError, OSError, ValueError) as error:
                self.reason = f"the run kept none, and its scene is not here ({clean(str(error))})"
        return self._scene


def read_png(path: Path) -> Pixels:
    """RGB pixels of a PNG. Raises OSError or ValueError if it is none, or too large to be a render."""
    if not path.is_file():  # opening a pipe would wait for whoever writes into it
        raise FileNotFoundError(f"{path.name} is not there")
    try:
        with Image.open(path, formats=("PNG",)) as picture:
            if picture.width * picture.height > LARGEST_PICTURE:
                raise ValueError(f"{path.name} is {picture.width} x {picture.height} px")
            return np.asarray(picture.convert("RGB"))
    except (SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path.name}: {error}") from error


def is_what_was_scored(render: Pixels, truth: Pixels, recorded: float | None) -> bool:
    """Whether a render against this truth has the PSNR that the record gives (nothing recorded: taken on trust)."""
    if render.shape != truth.shape:
        return False
    if recorded is None:
        return True
    # In blocks of rows: float64 copies of large pictures are large.
    total = sum(
        float(np.square(a.astype(np.float32) - b.astype(np.float32)).sum(dtype=np.float64))
        for a, b in zip(np.array_split(render, 8), np.array_split(truth, 8), strict=True)
    )
    measured, expected = total / (255.0**2 * render.size), 10 ** (-recorded / 10)
    return abs(measured - expected) <= SCORE_TOLERANCE * expected + ROUNDING_MSE


def _save(pixels: Pixels, path: Path) -> None:
    from splatwizard_core.api import replacing

    with replacing(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")
