"""The course of the protocol: each model drawn once, coded by every codec at every rate, decoded, drawn, scored."""

from __future__ import annotations

import dataclasses
import importlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from splatwizard_core.api import (
    CapabilityError,
    GaussianModel,
    MetricSetup,
    RasterOptions,
    SplatModel,
    UserInputError,
    psnr,
    ssim_map,
    track,
)
from splatwizard_core.tooling import (
    Entry,
    PluginManager,
    ResolvedConfig,
    Session,
    file_sha256,
    open_model,
    render_options,
    render_view,
    say,
    suggested_rasterizers,
    write_atomic,
    write_json,
)
from sw_bench.gsc import TITLE
from sw_bench.gsc.coding import CodecFailedError, code
from sw_bench.gsc.frames import joined
from sw_bench.gsc.scores import FOREGROUND, score
from sw_bench.gsc.tables import BD_COLUMNS, COLUMNS, Row, bd_rows, csv_text, parts_of, summary
from sw_bench.gsc.views import Asked, Views, views_of

ANCHOR = "gsc-quant"
EMPTY = 1.0  # % of a picture: a view of the source with less is left out
ALPHA_MAX = 0.99  # of rasterizers that declare nothing
ONE_RATE = "r0"  # of a codec without a dial


@dataclass(frozen=True)
class Plan:
    """Models, codecs and views that are asked for.

    files       models, of any format that is read here
    sequence    name of the sequence whose frames the files are; None: each is a scene
    alpha_max   limit of a splat's opacity in a pixel, which the rasterizer must have
    codecs      methods that encode a .ply; empty: all that declare `training_free`
    anchor      codec that BD-rates are against
    sets        keys of the codecs, as of --set
    range       "auto", or "fixed": gsc-quant refuses a model that its ranges would clip
    """

    files: Sequence[Path]
    out: Path
    codecs: Sequence[str] = ()
    anchor: str = ANCHOR
    asked: Asked = field(default_factory=Asked)
    sets: Sequence[str] = ()
    range: str = "auto"
    sequence: str | None = None
    alpha_max: float = ALPHA_MAX


@dataclass(frozen=True)
class Drawn:
    """Pictures of one model at the cameras: uint8 [3,H,W] pictures, and opacities [H,W] in levels."""

    pictures: list[Tensor]
    opacities: list[Tensor]


@dataclass(frozen=True)
class Source:
    """One model as it is given: its views without those that show next to nothing, and the protocol's ids."""

    name: str
    file: Path
    model: GaussianModel
    options: RasterOptions
    views: Views
    drawn: Drawn
    empty: list[str]
    clipped: list[str]
    ids: dict[str, str]
    all_views: Views


def bench_gsc(plan: Plan, session: Session, resolved: ResolvedConfig) -> dict[str, Any]:
    """Run the protocol; writes gsc.json, gsc.csv and gsc_bd.csv into the output folder, and returns the first.

    Raises UserInputError for what cannot be read or drawn. A codec that fails has rows without values, and a flag.
    """
    entries = codecs_of(plan, session)
    names = sequence_names(plan.files)
    rows: list[Row] = []
    sources: list[dict[str, Any]] = []
    views: Views | None = None
    for name, file in zip(names, plan.files, strict=True):
        source = open_source(name, file, plan, session, resolved, views)
        sources.append(_facts(source))
        if plan.sequence is not None:  # all frames are seen from where the first one is
            views = views or source.all_views
        for entry in entries:
            for rate in entry.declared.get("rates") or [None]:
                rows.append(_row(source, entry, rate, plan, session, resolved))
    if plan.sequence is not None:
        cells = dict.fromkeys((row["codec"], row["rate"]) for row in rows)
        rows = [joined(plan.sequence, [row for row in rows if (row["codec"], row["rate"]) == cell]) for cell in cells]
        first = {**sources[0], "sequence": plan.sequence, "protocol": rows[0]["protocol"]}
        sources = [first | {"frames": sources, "splats": sum(each["splats"] for each in sources)}]
    rows.sort(key=lambda row: (row["sequence"], row["codec"], row["rate"]))
    bd = bd_rows(rows, plan.anchor)
    found = {"protocol": TITLE, "anchor": plan.anchor, "sources": sources, "rows": rows, "bd": bd,
             "not_available": {} if plan.codecs else not_available(session.plugins)}  # fmt: skip
    write_json(plan.out / "gsc.json", found)
    write_atomic(plan.out / "gsc.csv", csv_text(COLUMNS, rows))
    write_atomic(plan.out / "gsc_bd.csv", csv_text(BD_COLUMNS, bd))
    return found


def codecs_of(plan: Plan, session: Session) -> list[Entry]:
    """The codecs that are asked for, or all that need no training and can be used here; the anchor among them.

    Raises UserInputError for one that trains, CapabilityError for one that is asked for and cannot be used.
    """
    methods = session.plugins.methods
    absent = not_available(session.plugins)
    wanted = list(plan.codecs)
    if not wanted:
        wanted = [e.name for e in methods if e.declared.get("training_free") and e.name not in absent]
        for name, reason in absent.items():
            say(f"{name} is left out: {reason}")
    if plan.anchor not in wanted and plan.anchor in methods:
        wanted.append(plan.anchor)
    found = [methods.entry(name) for name in dict.fromkeys(wanted)]
    if others := [entry.name for entry in found if not entry.declared.get("training_free")]:
        raise UserInputError(f"{', '.join(others)} has to train, and this protocol is for what need not")
    for entry in found:
        if entry.name in absent:
            raise CapabilityError(f"{entry.name}: {absent[entry.name]}")
    return found


def not_available(plugins: PluginManager) -> dict[str, str]:
    """Codecs that train nothing and cannot be used here, with the reason that the probe they declare gives."""
    found = {}
    for entry in plugins.methods:
        module, _, function = str(entry.declared.get("available", "")).partition(":")
        if entry.declared.get("training_free") and module:
            reason = getattr(importlib.import_module(module), function)()
            found |= {} if reason is None else {entry.name: reason}
    return found


def sequence_names(files: Sequence[Path]) -> list[str]:
    """A name for each file: its stem, with the folder's name where stems are equal. Raises UserInputError for twins."""
    stems = [file.name.partition(".")[0] for file in files]
    names = [
        stem if stems.count(stem) == 1 else f"{file.resolve().parent.name}-{stem}"
        for stem, file in zip(stems, files, strict=True)
    ]
    names = [re.sub(r"[^\w.-]+", "-", name) or "model" for name in names]
    if len(set(names)) < len(names):
        raise UserInputError("two of the files have one name: rename one, the tables tell them apart by it")
    return names


def open_source(
    name: str, file: Path, plan: Plan, session: Session, resolved: ResolvedConfig, views: Views | None = None
) -> Source:
    """Read a model, find its views, draw it. Raises UserInputError for one without Gaussians, or with broken values.

    views   where it is seen from; None: as the plan asks
    """
    from sw_interchange.gsc_quant import clipped_attributes

    model = session.plugins.read_gaussians(file)
    if not model.num_rows:
        raise UserInputError(f"{file}: it holds no Gaussian")
    left_out = model.origin.get("left_out", {}) if isinstance(model.origin, dict) else {}
    if broken := model.check_finite() + int(left_out.get("not_finite", 0)):
        raise UserInputError(f"{file}: {broken:,} Gaussians hold values that are not finite")
    clipped = clipped_attributes(model)
    if clipped and plan.range == "fixed":
        raise UserInputError(f"{file}: the ranges of gsc-quant would clip {', '.join(clipped)}; leave range=fixed out")
    model = model.to(session.device).eval().requires_grad_(False)
    model.prepare()
    raster = dict(model.origin.get("raster", {})) if isinstance(model.origin, dict) else {}
    options = dataclasses.replace(render_options(raster, torch.zeros(3, device=session.device)), alpha=True)
    views = views or views_of(file, model, plan.asked, session.plugins)
    if plan.sequence is not None:  # photographs are of one moment
        views = dataclasses.replace(views, photographs=None)
    sha = file_sha256(file)
    drawn, drawn_by = _draw(model, views, options, session, resolved, f"draw {name}")
    if not drawn_by.endswith(f"-{limit_word(plan.alpha_max)}"):
        raise UserInputError(
            f"no rasterizer on {session.device.type} draws it with an opacity limit of {plan.alpha_max:g}; {drawn_by} "
            "would: gsplat has 0.999, on a GPU"
        )
    shown = [i for i, opacity in enumerate(drawn.opacities) if occupancy(opacity) >= EMPTY]
    empty = [each for i, each in enumerate(views.names) if i not in shown]
    if not shown:
        raise UserInputError(f"{file}: no view shows more than {EMPTY:g} % of it: give other cameras")
    for each in empty:
        say(f"{name}: view {each} shows less than {EMPTY:g} % of the model and is left out (empty_view)")
    drawn = Drawn([drawn.pictures[i] for i in shown], [drawn.opacities[i] for i in shown])
    tail = "" if not clipped else f"/range-auto:{'+'.join(clipped)}"
    ids = {
        kind: f"gsc-{sha[:8]}/{views.label}/{views.size}/{kind}/black/{drawn_by}/q8{tail}" for kind in ("src", "photos")
    }
    source = Source(name, file, model, options, views.part(shown), drawn, empty, clipped, ids, views)
    _keep(source, plan.out / name / "reference")
    return source


def occupancy(opacity: Tensor) -> float:
    """Share of a picture that the model covers, %."""
    return 100.0 * (opacity >= FOREGROUND).double().mean().item()


def _draw(
    model: SplatModel, views: Views, options: RasterOptions, session: Session, resolved: ResolvedConfig, label: str
) -> tuple[Drawn, str]:
    """Draw a model at the cameras, rounded to 8 bit; and who drew it, as the protocol's id has it."""
    raster = getattr(model, "origin", {}).get("raster", {})
    rasterizer = session.rasterizer(resolved, suggested_rasterizers(raster))
    pictures, opacities = [], []
    with track(label, total=len(views.cameras), unit="views") as bar:
        for camera in views.cameras:
            result = render_view(model, camera.to(session.device), rasterizer, options)
            rasterizer.look(result)
            pictures.append(_levels(result.image))
            assert result.alpha is not None
            opacities.append(_levels(result.alpha)[0])
            bar.advance()
    names = sorted(set(rasterizer.drawn_by.values()))
    entries = [session.plugins.rasterizers.entry(each) for each in names]
    limits = {limit_word(each.declared.get("alpha_max", ALPHA_MAX)) for each in entries}
    versions = "+".join(f"{each.name}-{each.version}" for each in entries)
    return Drawn(pictures, opacities), f"{versions}-{'+'.join(sorted(limits))}"


def limit_word(alpha_max: float) -> str:
    """Word of the protocol's id for a limit of opacity: a99, a999."""
    return f"a{f'{alpha_max:g}'.partition('.')[2]}"


def _levels(image: Tensor) -> Tensor:
    """0..1 as uint8 on the CPU."""
    return torch.round(image.clamp(0, 1) * 255).byte().cpu()


def _keep(source: Source, folder: Path) -> None:
    """Write the source's pictures with their opacity as PNG, once."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, (picture, opacity) in enumerate(zip(source.drawn.pictures, source.drawn.opacities, strict=True)):
        pixels = torch.cat([picture, opacity[None]]).permute(1, 2, 0).numpy()
        Image.fromarray(np.ascontiguousarray(pixels)).save(folder / f"{i:03d}.png")


def _row(source: Source, entry: Entry, rate: str | None, plan: Plan, session: Session, resolved: ResolvedConfig) -> Row:
    """One codec at one rate; kept from an earlier run where nothing that it depends on has changed."""
    shown = ONE_RATE if len(entry.declared.get("rates") or []) < 2 else str(rate)
    folder = plan.out / source.name / entry.name
    key = {
        "protocol": source.ids, "codec": entry.name, "version": f"{entry.distribution} {entry.version}", "rate": rate,
        "sets": list(plan.sets), "views": source.views.names,
    }  # fmt: skip
    kept = folder / f"{shown}.json"
    if kept.is_file() and (found := json.loads(kept.read_bytes())).get("key") == key:
        row: Row = found["row"]
        return row
    row = {
        "sequence": source.name, "codec": entry.name, "rate": shown, "protocol": source.ids["src"], "frames": 1,
        "splats_source": source.model.num_rows, "flags": "", **dict.fromkeys(("bytes", "infinite_views")),
    }  # fmt: skip
    try:
        file = folder / f"{shown}.swz"
        coded = code(source.file, file, entry.name, rate, list(plan.sets), session.device.type)
    except CodecFailedError as error:
        say(f"{source.name}: {entry.name} {shown} failed: {error}")
        return row | {"flags": "failed", "reason": str(error)}
    model, reader = open_model(file, session.plugins, session.device)
    if model.digest() != coded.digest:
        say(f"{source.name}: {entry.name} {shown}: two processes decode different models from the same file")
        return row | {"flags": "failed", "reason": "two processes decode different models"}
    model.prepare()
    options = dataclasses.replace(render_options(reader.raster, source.options.background), alpha=True)
    label = f"{source.name} {entry.name} {shown}"
    drawn, _ = _draw(model, source.views, options, session, resolved, label)
    scores = []
    for i, picture in enumerate(drawn.pictures):
        mask = (source.drawn.opacities[i] >= FOREGROUND) | (drawn.opacities[i] >= FOREGROUND)
        compared = (each.to(session.device) for each in (source.drawn.pictures[i], picture, mask))
        scores.append(dataclasses.asdict(score(*compared)))
    flags = ["sh-dropped"] if getattr(model, "max_sh_degree", 0) < source.model.active_sh_degree else []
    row |= {
        "splats_decoded": coded.splats, "bytes": coded.bytes, "bits_per_splat": 8 * coded.bytes / source.model.num_rows,
        **parts_of(coded.sections, coded.bytes), **summary(scores), "enc_s": coded.encode_s, "dec_s": coded.decode_s,
        "rss_enc_mb": coded.rss_encode_mb, "rss_dec_mb": coded.rss_decode_mb, "flags": " ".join(flags),
    }  # fmt: skip
    if row["infinite_views"]:
        row["flags"] = " ".join([*flags, "infinite"])
    row["per_view"] = [{"view": name, **each} for name, each in zip(source.views.names, scores, strict=True)]
    if source.views.photographs is not None:
        row["photos"] = _photos(source, drawn, session)
    write_json(kept, {"key": key, "row": row})
    return row


def _photos(source: Source, drawn: Drawn, session: Session) -> dict[str, Any]:
    """Scores against the photographs, of the decoded model and of the source, and how far the former is below."""
    metrics: dict[str, Any] = {
        "psnr": psnr,
        "ssim": lambda a, b: float(ssim_map(a, b).double().mean()),
    }
    if "lpips_vgg_3dgs" in session.plugins.metrics:
        try:
            target: Any = session.plugins.metrics.load("lpips_vgg_3dgs")
            metrics["lpips_vgg_3dgs"] = target.prepare(MetricSetup(session.device)).compute
        except CapabilityError:
            pass  # its weights are not here: no value
    found: dict[str, Any] = {"protocol": source.ids["photos"]}
    truths = [view.image(torch.zeros(3)).to(session.device) for view in source.views.photographs or []]
    for name, compute in metrics.items():
        of = {
            who: [float(compute(picture.to(session.device) / 255, truth))
                  for picture, truth in zip(pictures, truths, strict=True)]
            for who, pictures in (("decoded", drawn.pictures), ("source", source.drawn.pictures))
        }  # fmt: skip
        means = {who: sum(values) / len(values) for who, values in of.items()}
        found[name] = {**means, "drop": means["source"] - means["decoded"]}
    return found


def _facts(source: Source) -> dict[str, Any]:
    return {
        "sequence": source.name,
        "file": source.file.name,
        "protocol": source.ids["src"],
        "splats": source.model.num_rows,
        "sh_degree": source.model.active_sh_degree,
        "views": source.views.names,
        "empty_views": source.empty,
        "range_auto": source.clipped,
        "notes": source.views.notes,
    }
