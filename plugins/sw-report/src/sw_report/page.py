"""Composition of the page: one self-contained HTML file about one run or many."""

from __future__ import annotations

import base64
import hashlib
import importlib.metadata
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import cache
from pathlib import Path
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from splatwizard_core.tooling import as_installed, several, write_atomic
from sw_report import numbers, plots
from sw_report import results_tables as tables
from sw_report.aggregate import dataset_tables
from sw_report.blocks import Part, Section, Table
from sw_report.by_scene import scene_charts
from sw_report.commands import commands_table
from sw_report.declared import metric_style
from sw_report.distance import HEADING as HOW_FAR
from sw_report.distance import distance_parts, sheet_section
from sw_report.distortion import bd_tables, choose_anchor, with_values
from sw_report.dtu_table import dtu_table
from sw_report.facts import RunFacts
from sw_report.geometry import geometry_parts
from sw_report.method_styles import styles_of
from sw_report.pictures import (
    GAIN,
    LONGEST_SIDE,
    LONGEST_SIDE_OF_MANY,
    PictureBudget,
    scene_gallery,
    single_gallery,
    views_per_scene,
)
from sw_report.prefixes import HEADING, prefix_parts
from sw_report.runs import Collection, Run
from sw_report.truth import EVEN_VIEWS, SceneOpener, Truth

FILE_NAME = "report.html"
SCENE_PAGE = "scene.html"
"""Of a run directory: the scene in 3D."""
MOST_LINKS = 40
PICTURES = "Renders beside the ground truth"
BYTES = "Bytes by section"
VIEWS = "Scores view by view"
SHORT = {PICTURES: "Pictures", BYTES: "Bytes", VIEWS: "Views"}
"""Headings, and what stands for them in the contents."""


@dataclass(frozen=True)
class PageOptions:
    """Contents of a page.

    anchor      variant or method that BD-rates compare against; None: the usual one
    partial     means also where scenes are missing
    pareto      BD-rates after dropping points that a smaller file beats
    opener      (run) -> its scene, for ground truth that a run did not keep; None: only what runs kept
    pictures    whether there are any
    """

    anchor: str | None = None
    partial: bool = False
    pareto: bool = False
    opener: SceneOpener | None = None
    pictures: bool = True


def _unbroken(text: str) -> str:
    """A mean and its deviation may stand below each other, but a sign stays with its number."""
    return text.replace(f" {numbers.PLUS_MINUS} ", f" {numbers.PLUS_MINUS}\N{NO-BREAK SPACE}")


def write_page(collection: Collection, path: Path, options: PageOptions | None = None) -> None:
    """Write the page about these runs, atomically."""
    write_atomic(path, render_page(collection, options or PageOptions(), path.parent))


def render_page(collection: Collection, options: PageOptions, folder: Path | None = None) -> str:
    """Return the HTML text. Raises UserInputError for an anchor that no run is of.

    folder  where the page will lie, for its links to the scenes in 3D beside the records; None: no links
    """
    runs = collection.runs
    single = len(runs) == 1 and not runs[0].repeats
    return _rendered(
        _title(runs), _lede(runs), collection.notes,
        _single_sections(runs[0], options) if single else _many_sections(runs, options),
        figures=_key_figures(runs[0]) if single else [],
        scenes=[] if folder is None else scene_links(runs, folder),
        side=LONGEST_SIDE if single else LONGEST_SIDE_OF_MANY,
    )  # fmt: skip


def write_sheet(collection: Collection, path: Path) -> None:
    """Write the page about how far from the training views models hold, atomically.

    Raises UserInputError if no record says how far its test views lie from the training views.
    """
    runs = collection.runs
    section = sheet_section(runs, styles_of(runs))
    write_atomic(path, _rendered(HOW_FAR, _lede(runs), collection.notes, [section]))


def _rendered(
    title: str,
    lede: str,
    notes: Sequence[str],
    sections: Sequence[Section],
    *,
    figures: Sequence[dict[str, str]] = (),
    scenes: Sequence[tuple[str, str]] = (),
    side: int = LONGEST_SIDE,
) -> str:
    """Return the HTML text of a page."""
    template = page_template()
    loader = template.environment.loader
    assert loader is not None
    style, script = (loader.get_source(template.environment, name)[0] for name in ("style.css", "script.js"))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    return template.render(
        title=title,
        lede=lede,
        date=datetime.now(timezone.utc).strftime("%d %B %Y").lstrip("0"),
        version=importlib.metadata.version("splatwizard-core"),
        figures=figures,
        notes=notes,
        scenes=scenes,
        contents=[(section.id, section.short or section.title) for section in sections],
        sections=sections,
        style=Markup(style),
        script=Markup(script),
        script_hash=f"sha256-{digest}",
        gain=GAIN,
        side=side,
    )


@cache
def page_template() -> Template:
    """The page's template, compiled once in a process."""
    environment = Environment(
        loader=PackageLoader("sw_report"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
        # Advice as the terminal gives it; what is marked up already is ours.
        finalize=lambda value: as_installed(value) if type(value) is str else value,
    )  # fmt: skip
    environment.filters["unbroken"] = _unbroken
    environment.filters["capfirst"] = lambda text: text[:1].upper() + text[1:]
    return environment.get_template("page.html.j2")


def scene_links(runs: Sequence[Run], folder: Path) -> list[tuple[str, str]]:
    """Return (address relative to `folder`, name) of the pages in 3D that sw-view left beside the records."""
    found = []
    for run in runs:
        page = run.directory / SCENE_PAGE
        if page.is_file():
            name = "Look at it in 3D" if len(runs) == 1 else f"{run.label} on {run.facts.scene}"
            found.append((quote(os.path.relpath(page, folder).replace(os.sep, "/")), name))
    return found[:MOST_LINKS]


def _unique(values: Sequence[str]) -> list[str]:
    return list(dict.fromkeys(values))


def _title(runs: Sequence[Run]) -> str:
    methods, scenes = _unique([r.variant for r in runs]), _unique([r.facts.scene for r in runs])
    if len(runs) == 1:
        return f"{runs[0].label} on {scenes[0]}"
    who = methods[0] if len(methods) == 1 else " and ".join(methods) if len(methods) == 2 else f"{len(methods)} methods"
    where = scenes[0] if len(scenes) == 1 else " and ".join(scenes) if len(scenes) == 2 else f"{len(scenes)} scenes"
    return f"{who} on {where}"


def _lede(runs: Sequence[Run]) -> str:
    facts = runs[0].facts
    made = sum(len(run.seeds) for run in runs)
    if made > 1:
        methods, scenes = _unique([r.variant for r in runs]), _unique([r.facts.scene for r in runs])
        protocols = _unique([r.facts.protocol.id for r in runs])
        sizes = sorted(r.size for r in runs)
        return (
            f"{made} runs: {several(len(methods), 'method')} on {several(len(scenes), 'scene')}, under "
            f"{several(len(protocols), 'protocol')}. Files of {numbers.megabytes(sizes[0])} to "
            f"{numbers.megabytes(sizes[-1])} MB; every score is of a model that was decoded from its file."
        )
    stored = numbers.counts(facts.counts) + (" Gaussians" if list(facts.counts) == ["num_gaussians"] else "")
    views = facts.test_views or len(facts.views)
    psnr = runs[0].mean("psnr")
    reached = f" that reach {psnr:.2f} dB on {several(views, 'test view')}" if psnr is not None else ""
    form = f" in {facts.uncompressed()}, not compressed," if facts.uncompressed() else ""
    return f"{numbers.megabytes(facts.file.bytes)} MB hold {stored}{form}{reached}; every score is of the decoded file."


def _key_figures(run: Run) -> list[dict[str, str]]:
    facts = run.facts
    found = []
    for name in tables.metric_names([run]):
        style = metric_style(name)
        found.append({"name": style.label, "value": numbers.score(name, run.mean(name)), "unit": style.unit})
    found.append({"name": "file size", "value": numbers.megabytes(facts.file.bytes), "unit": "MB"})
    for name, n in facts.counts.items():
        found.append({"name": numbers.unit(name), "value": f"{n:,}", "unit": ""})
    frames = numbers.shared(numbers.rate(facts.speed.fps), "render" in facts.contended)
    found.append({"name": "rendering", "value": frames, "unit": "FPS"})
    return found


def _single_sections(run: Run, options: PageOptions) -> list[Section]:
    facts = run.facts
    sections = []
    if options.pictures:
        gallery = single_gallery(run, Truth([run], options.opener), PictureBudget())
        sections.append(Section("pictures", PICTURES, [Part(gallery=gallery)], short=SHORT[PICTURES]))
    views = plots.view_charts([run], styles_of([run]))
    parts = [Part(charts=views)] if views is not None else [Part(text="The record holds no scores of single views.")]
    table = plots.views_table([run])
    parts += [Part(table=table, folded="All scores")] if table is not None else []
    missing = tables.missing_metrics([run])
    parts += [Part(text="Not known: " + "; ".join(missing) + ".")] if missing else []
    sections.append(Section("views", VIEWS, parts, _of_training_views(facts), SHORT[VIEWS]))
    if parts := distance_parts([run], styles_of([run])):
        sections.append(Section("distance", HOW_FAR, [replace(part, heading="") for part in parts], short="Distance"))
    table = plots.single_sections_table(run)
    part = Part(table=table) if table is not None else Part(text="The record lists no sections of the file.")
    sections.append(Section("bytes", BYTES, [part], short=SHORT[BYTES]))
    if parts := prefix_parts([run], styles_of([run])):
        sections.append(Section("prefixes", HEADING, [replace(part, heading="") for part in parts], short="Prefixes"))
    sections.append(_training("training", "Training", [run], tables.breakdown_table(facts)))
    sections.append(Section("cost", "Time and memory", [Part(table=tables.cost_table(facts))]))
    if parts := geometry_parts(run, pictures=options.pictures):
        sections.append(Section("geometry", "Geometry", parts))
    sections.append(_provenance([run]))
    return sections


def _of_training_views(facts: RunFacts) -> str:
    """Tell the PSNR over the training views, which stand in no table; empty if the record does not have it."""
    found = facts.training_psnr
    if found is None or found.mean is None or found.quantile_05 is None:
        return ""
    return f"Training views: PSNR {found.mean:.2f} dB in the mean; 5 % of them have {found.quantile_05:.2f} dB or less."


def _many_sections(runs: Sequence[Run], options: PageOptions) -> list[Section]:
    """Results, curves, pictures; then BD values; then the rest."""
    style_of = styles_of(runs)
    sections = []
    means = dataset_tables(runs, partial=options.partial)
    if means:
        parts = []
        for table in means:
            parts.append(Part(f"{table.title}: {', '.join(table.protocols)}", table=tables.means_table(table)))
            own = [r for r in runs if r.facts.dataset == table.dataset and r.facts.protocol.id in table.protocols]
            curves = plots.mean_charts(table, own, style_of)
            parts += [Part(charts=curves)] if curves is not None else []
            by_scene = scene_charts(own, style_of)
            parts += [Part("Scene by scene", charts=by_scene)] if by_scene is not None else []
        sections.append(Section("means", "Means over scenes", parts, short="Means"))
    if (dtu := dtu_table(runs)) is not None:
        sections.append(Section("dtu", "DTU", [Part(table=dtu)]))
    places: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        places.setdefault(run.place, []).append(run)
    budget = PictureBudget()
    views = views_per_scene([len(group) for group in places.values()], EVEN_VIEWS)
    scenes = [scene for scene, _ in places]
    for number, ((scene, protocol), group) in enumerate(places.items()):
        title = scene if scenes.count(scene) == 1 else f"{scene}, {protocol}"
        answer, rest = _answer(group, style_of, views, budget, options), _rest(group, style_of)
        if len(places) == 1:  # what would be sub-headings under a lonely heading
            sections += _as_sections(answer, f"Results on {scene}", f"Protocol {protocol}.")
            sections += _bd_sections(runs, options)
            sections += _as_sections(rest)
        else:
            parts = [*answer, *rest]
            sections.append(Section(f"scene-{number}", title, parts, f"Protocol {protocol}.", title))
    if len(places) > 1:
        sections += _bd_sections(runs, options)
    sections.append(_provenance(runs))
    return sections


def _bd_sections(runs: Sequence[Run], options: PageOptions) -> list[Section]:
    """BD values, if there are any; where several methods have none, why."""
    anchor = choose_anchor(runs, options.anchor)
    shown, missing = with_values(bd_tables(runs, anchor, pareto=options.pareto, partial=options.partial))
    text = "Mean distance between rate-distortion curves, scene by scene (Bjøntegaard; monotone piecewise cubic)."
    parts = [
        Part(f"{numbers.heading(t.metric)} · {t.protocol}" if i else "", table=tables.bd_table(t))
        for i, t in enumerate(shown)
    ]
    if parts and missing:
        parts.append(Part(text=" ".join(missing)))
    return [Section("bd", "Rate saved against the anchor", parts, text, "BD-rate")] if parts else []


def _as_sections(parts: Sequence[Part], title: str = "", text: str = "") -> list[Section]:
    """A section for every part with a heading; those without one belong to the section before them."""
    sections = [Section("results", title, [], text, "Results")] if title else []
    for part in parts:
        if part.heading:
            name = "-".join(part.heading.lower().split())
            sections.append(Section(name, part.heading, [], short=SHORT.get(part.heading, "")))
        sections[-1].parts.append(replace(part, heading=""))
    return sections


def _answer(
    runs: Sequence[Run], style_of: dict[str, int], views: int, budget: PictureBudget, options: PageOptions
) -> list[Part]:
    """Compose what the runs of one scene under one protocol reach: table, curves, pictures."""
    parts = [Part(table=tables.runs_table(runs))]
    charts = plots.distortion_charts(runs, style_of)
    if charts is not None and len(runs) > 1:
        parts.append(Part("Rate and distortion", charts=charts))
    parts += prefix_parts(runs, style_of)
    if options.pictures:
        if budget.spent:
            parts.append(Part(PICTURES, "Left out: the page holds as many pictures as it may."))
        else:
            gallery = scene_gallery(runs, views, Truth(runs, options.opener), budget)
            parts.append(Part(PICTURES, gallery=gallery))
    return parts


def _rest(runs: Sequence[Run], style_of: dict[str, int]) -> list[Part]:
    """Compose how they reach it: bytes by section, training, scores view by view."""
    parts = []
    bars = plots.section_bars(runs)
    if bars is not None:
        parts.append(Part(BYTES, charts=bars))
        parts.append(Part(table=plots.sections_table(runs), folded="Bytes as a table"))
    curves, missing = plots.training_charts(runs, style_of)
    parts.append(Part("Training", charts=curves, text=_sentence(missing)))
    by_view = plots.view_charts(runs, style_of)
    if by_view is not None:
        parts.append(Part(VIEWS, charts=by_view))
        parts.append(Part(table=plots.views_table(runs), folded="All scores"))
    return [*parts, *distance_parts(runs, style_of)]


def _training(anchor: str, title: str, runs: Sequence[Run], breakdown: Table | None) -> Section:
    style_of = styles_of(runs)
    curves, missing = plots.training_charts(runs, style_of)
    parts = [Part(charts=curves, text=_sentence(missing))]
    if breakdown is not None:
        parts.append(Part("Where the time went", table=breakdown))
    return Section(anchor, title, parts)


def _sentence(missing: Sequence[str]) -> str:
    return f"Not shown: {'; '.join(missing)}." if missing else ""


def _provenance(runs: Sequence[Run]) -> Section:
    phases = tables.phases_table(runs)
    commands = commands_table(list(runs))
    parts = [
        *([Part("Commands", table=commands)] if commands is not None else []),
        Part("Served by", table=tables.served_table(runs)),
        *([Part("Phases", table=phases)] if phases is not None else []),
        Part("Protocol", table=tables.protocol_table(runs)),
        Part("Environment", table=tables.environment_table(runs)),
    ]
    if len(runs) == 1:
        config = tables.config_table(runs[0].facts)
        if config is not None:
            parts.append(Part("Configuration", table=config, folded="Every value, and where it was set"))
    text = _identity(runs[0]) if len(runs) == 1 else ""
    return Section("provenance", "How it was measured", parts, text, "Protocol and environment")


def _identity(run: Run) -> str:
    facts = run.facts
    known = [
        f"Measured {facts.date}." if facts.date else "",
        f"Flags: {', '.join(facts.flags)}." if facts.flags else "",
        f"SHA-256 of the file: {facts.file.sha256}." if facts.file.sha256 else "",
    ]
    return " ".join(filter(None, known))
