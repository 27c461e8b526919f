"""Pictures for the page: renders, ground truth and differences as data: URIs, within a budget that the page tells."""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from PIL import Image

from sw_report.facts import clean
from sw_report.runs import Run
from sw_report.truth import (
    RENDERS,
    Pixels,
    Truth,
    even_views,
    is_what_was_scored,
    picture_names,
    read_png,
    shown_views,
)

LONGEST_SIDE = 960  # px, of a page about one run
LONGEST_SIDE_OF_MANY = 640
MOST_PICTURES = 160  # on one page
MOST_RUNS = 8  # beside one photograph
MOST_BYTES = 9_000_000  # of all pictures; a third more as text
QUALITY = 88  # JPEG
GAIN = 4  # of differences
OTHER_TRUTH = "{}: no difference, the photograph is not the one that its record was scored against"


@dataclass(frozen=True)
class Picture:
    """One picture as the page holds it; width and height are its own, not the render's."""

    uri: str
    width: int
    height: int


@dataclass(frozen=True)
class Shown:
    """One run's render of a view, and its difference from the truth; None with a reason."""

    run: Run
    psnr: float | None
    render: Picture | None
    difference: Picture | None
    reason: str = ""


@dataclass(frozen=True)
class ViewRow:
    """Pictures of one view: the photograph and the render of each run.

    remark  why this view is shown, where it is not by even choice
    """

    name: str
    truth: Picture | None
    shown: list[Shown]
    remark: str = ""
    reason: str = ""

    @property
    def portrait(self) -> bool:
        """Whether the pictures are higher than wide."""
        known = [p for p in (self.truth, *(s.render for s in self.shown)) if p is not None]
        return bool(known) and known[0].height > known[0].width


@dataclass
class Gallery:
    """Pictures of one scene; `notes` says what is missing and what was left out."""

    rows: list[ViewRow]
    notes: list[str] = field(default_factory=list)


class PictureBudget:
    """Count of the pictures and bytes that the page may still hold."""

    def __init__(self, pictures: int = MOST_PICTURES, size: int = MOST_BYTES) -> None:
        self.pictures, self.size = pictures, size
        self.used = 0

    def take(self, picture: Picture | None) -> Picture | None:
        """Return the picture if there is room for it, else None."""
        if picture is None or self.pictures <= 0 or self.used + len(picture.uri) * 3 // 4 > self.size:
            return None
        self.pictures -= 1
        self.used += len(picture.uri) * 3 // 4
        return picture

    @property
    def spent(self) -> bool:
        """Whether there is room for no further picture."""
        return self.pictures <= 0 or self.used >= 0.97 * self.size


def views_per_scene(runs_by_scene: Sequence[int], most: int) -> int:
    """Number of views of each scene that fit onto a page, at most `most`, at least 1."""
    pictures = sum(1 + 2 * min(runs, MOST_RUNS) for runs in runs_by_scene) or 1
    return max(1, min(most, MOST_PICTURES // pictures))


def single_gallery(run: Run, truth: Truth, budget: PictureBudget, side: int = LONGEST_SIDE) -> Gallery:
    """Pictures of one run: views spread evenly, the worst and the best."""
    indices = shown_views(run.facts)
    even = set(even_views(len(run.facts.views)))
    scores = _scores(run)
    known = {i: s for i, s in scores.items() if s is not None}
    remarks = {}
    if len(known) > 1:
        for word, pick in (("lowest", min), ("highest", max)):
            i = pick(known, key=lambda i: known[i])
            remarks[i] = f"{word} PSNR of all views"
    order = sorted(indices, key=lambda i: (i not in even, i))
    return _gallery([run], [run.facts.views[i] for i in order], truth, budget, side,
                    {run.facts.views[i]: text for i, text in remarks.items()})  # fmt: skip


def scene_gallery(
    runs: Sequence[Run], views: int, truth: Truth, budget: PictureBudget, side: int = LONGEST_SIDE_OF_MANY
) -> Gallery:
    """Pictures of several runs of one scene and protocol: the same views of each."""
    views_of = [set(run.facts.views) for run in runs]
    common = [name for name in runs[0].facts.views if all(name in views for views in views_of)]
    chosen = [common[i] for i in even_views(len(common))]
    chosen = [chosen[i] for i in even_views(len(chosen), min(views, len(chosen)))] if chosen else []
    picked = pick_evenly(runs, MOST_RUNS)
    gallery = _gallery(picked, chosen, truth, budget, side, {})
    if len(picked) < len(runs):
        gallery.notes.append(f"pictures of {len(picked)} of {len(runs)} runs, spread evenly over the table")
    return gallery


def pick_evenly(runs: Sequence[Run], most: int) -> list[Run]:
    """At most `most`, first and last among them."""
    if len(runs) <= most:
        return list(runs)
    return [runs[round(i * (len(runs) - 1) / (most - 1))] for i in range(most)]


def _gallery(
    runs: Sequence[Run], views: Sequence[str], truth: Truth, budget: PictureBudget, side: int, remarks: dict[str, str]
) -> Gallery:
    if not views:
        return Gallery([], ["the records name no test views"])
    rows: list[ViewRow] = []
    notes: dict[str, None] = {}
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for view in views:
            if budget.spent:
                notes["some views are left out: the page holds as many pictures as it may"] = None
                break
            photograph = truth.find(view)
            reason = "" if photograph is not None else f"no ground truth: {truth.reason}"
            made = list(pool.map(lambda run, v=view, t=photograph: _show(run, v, t, side), runs))
            scored = photograph is not None and (
                any(s.difference is not None for s in made) or all(s.render is None for s in made)
            )
            if photograph is not None and not scored:
                reason = "no ground truth: the picture found is not the one that was scored"
            picture = budget.take(encode(photograph, side)) if photograph is not None and scored else None
            kept = [
                Shown(s.run, s.psnr, budget.take(s.render), budget.take(s.difference), s.reason) for s in made
            ]  # fmt: skip
            if any(a.render is not None and b.render is None for a, b in zip(made, kept, strict=True)):
                notes["some pictures are left out: the page holds as many as it may"] = None
            found = [reason, *(f"{s.run.label}: {s.reason}" for s in kept if s.reason)]
            if scored:
                found += [OTHER_TRUTH.format(s.run.label) for s in made if s.render and not s.difference]
            notes.update(dict.fromkeys(filter(None, found)))
            rows.append(ViewRow(view, picture, kept, remarks.get(view, ""), reason))
    return Gallery(rows, list(notes))


def _show(run: Run, view: str, truth: Pixels | None, side: int) -> Shown:
    """Encode one run's render of a view and its difference from the truth."""
    index = run.facts.views.index(view)
    psnr = _scores(run).get(index)
    path = run.directory / RENDERS / picture_names(run.facts.views)[index]
    try:
        render = read_png(path)
    except FileNotFoundError:
        return Shown(run, psnr, None, None, "its renders are not in its folder")
    except (OSError, ValueError) as error:
        return Shown(run, psnr, None, None, f"a render cannot be read ({clean(str(error))})")
    difference = None
    if truth is not None and is_what_was_scored(render, truth, psnr):
        far = np.maximum(render, truth) - np.minimum(render, truth)
        difference = encode(_gained(far), side)
    return Shown(run, psnr, encode(render, side), difference)


def _gained(far: Pixels) -> Pixels:
    table = np.minimum(np.arange(256) * GAIN, 255).astype(np.uint8)
    gained: Pixels = table[far]
    return gained


def _scores(run: Run) -> dict[int, float | None]:
    metric = run.facts.metrics.get("psnr")
    return {} if metric is None else dict(enumerate(metric.per_view[: len(run.facts.views)]))


def encode(pixels: Pixels, side: int) -> Picture:
    """A JPEG of at most `side` px as a data: URI; smaller pictures keep their size."""
    picture = Image.fromarray(pixels)
    if max(picture.size) > side:
        picture.thumbnail((side, side), Image.Resampling.LANCZOS, reducing_gap=3.0)
    buffer = io.BytesIO()
    picture.save(buffer, format="JPEG", quality=QUALITY, subsampling=0)
    text = base64.b64encode(buffer.getvalue()).decode("ascii")
    return Picture(f"data:image/jpeg;base64,{text}", *picture.size)
