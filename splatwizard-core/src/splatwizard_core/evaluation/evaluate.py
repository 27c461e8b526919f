"""Image quality of a model over views, by the registered metrics."""

from __future__ import annotations

import itertools
import json
import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.base.files import replacing
from splatwizard_core.base.progress import counted, track
from splatwizard_core.errors import BitstreamError, SceneError, out_of_memory
from splatwizard_core.evaluation.image import prepare_render
from splatwizard_core.evaluation.metrics import (
    MetricInfo,
    MetricSettings,
    MetricSetup,
    PreparedMetric,
    chosen_metrics,
    measured,
    noting_failure,
    prepare_metric,
)
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.plugins import PluginManager
from splatwizard_core.plugins.registry import Entry
from splatwizard_core.rendering.rasterizer import Rasterizer, RasterOptions, RenderResult
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import Scene, View

# What a file may ask of a rasterizer, and the type of the value; whatever else its `raster` holds is for the method.
RASTER_KEYS: Mapping[str, type] = {"profile": str, "antialias": bool, "eps2d": float, "clamp_color": bool}

INFINITE = "infinite in at least one view (identical images)"
NOT_A_NUMBER = "not a number in at least one view (the render holds values that are not finite)"


@dataclass(frozen=True)
class MetricResult:
    """One metric over the views, or of the model itself: then without `per_view`.

    mean        over the views; None if unknown, or infinite
    per_view    in the order of the views; None where the value is not finite
    direction   "higher" or "lower" is better
    reason      why there is no mean, else None
    diagnostic  computed to tell conventions apart, not for tables
    made_with   what else the values depend on: versions, weights and their checksums
    verified    False: `made_with` names something that is not the published one
    details     of a metric over models its protocol, and what its value consists of: JSON data
    """

    mean: float | None
    per_view: list[float | None]
    direction: str
    reason: str | None = None
    diagnostic: bool = False
    made_with: Mapping[str, str] = field(default_factory=dict)
    verified: bool = True
    details: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Subject:
    """A decoded model, and all that a metric over models is given besides: `rasterizer` and `options` draw it.

    static      values of its file's header
    keep        folder for files that show what was measured, made by whoever writes them; None: they are not kept
    """

    model: SplatModel
    scene: Scene
    rasterizer: Rasterizer
    options: RasterOptions
    setup: MetricSetup
    static: Mapping[str, Any]
    keep: Path | None = None


@dataclass(frozen=True)
class EvaluationResult:
    """Quality over views.

    views               names
    metrics             by registry name
    visible_gaussians   mean over the views of the number with radius > 0
    drawn_gaussians     mean over the views of the number handed to the rasterizer
    """

    views: list[str]
    metrics: dict[str, MetricResult]
    visible_gaussians: float
    drawn_gaussians: float
    renders: list[str] = field(default_factory=list)


def render_options(raster: Mapping[str, Any], background: Tensor | None) -> RasterOptions:
    """Options that draw a decoded scene as its file asks, on `background` [3].

    Raises BitstreamError for a value that makes no sense.
    """
    asked: dict[str, Any] = {}
    for key in RASTER_KEYS.keys() & raster.keys():
        value, kind = raster[key], RASTER_KEYS[key]
        is_size = kind is float and type(value) in (int, float) and 0 <= value < math.inf
        if not is_size and (kind is float or type(value) is not kind or len(str(value)) > 64):
            raise BitstreamError(f"the file asks for rasterizer option {key} = {value!r:.80}, which makes no sense")
        asked[key] = kind(value)
    return RasterOptions(background=background, **asked)


def suggested_rasterizers(raster: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the rasterizers that a file prefers (`prefer` in its header), best first, installed or not.

    Raises BitstreamError if that is no short list of names.
    """
    names = raster.get("prefer", [])
    if not isinstance(names, list) or len(names) > 16 or not all(isinstance(n, str) and len(n) <= 64 for n in names):
        raise BitstreamError(f"the file prefers the rasterizers {names!r:.80}, which is no list of at most 16 names")
    return tuple(names)


def raster_header(options: RasterOptions) -> dict[str, Any]:
    """The options that belong into the file, since they change the picture: the inverse of `render_options`."""
    default = RasterOptions()
    return {key: getattr(options, key) for key in RASTER_KEYS if getattr(options, key) != getattr(default, key)}


def kept_header(model: SplatModel, options: RasterOptions, chosen: Mapping[str, Any]) -> dict[str, Any]:
    """The header of a model that is not trained: `chosen` wins over what its own file asks for, that over `options`."""
    asked = raster_header(render_options(getattr(model, "origin", {}).get("raster", {}), None))
    return raster_header(replace(options, **{**asked, **chosen}))


def render_view(model: SplatModel, camera: Camera, rasterizer: Rasterizer, options: RasterOptions) -> RenderResult:
    """Draw one view without gradients. Raises DeviceMemoryError where a GPU's memory does not suffice."""
    try:
        with torch.no_grad():
            return rasterizer.render(model.gaussians(camera, rasterizer), camera, options)
    except torch.cuda.OutOfMemoryError as error:
        doing = f"a view of {counted(model.counts())} at {camera.width}x{camera.height}"
        raise out_of_memory(error, doing, "free the GPU, or compute with --device cpu") from error


def evaluate(
    model: SplatModel,
    views: Sequence[View],
    rasterizer: Rasterizer,
    plugins: PluginManager,
    *,
    device: torch.device,
    options: RasterOptions,
    quantize8: bool = True,
    metrics: Sequence[str] | None = None,
    metric_settings: MetricSettings | None = None,
    masked: bool = False,
    save_to: Path | None = None,
    label: str = "evaluate",
) -> EvaluationResult:
    """Draw every view at the size of its picture and compare.

    device      where the model is
    options     as `render_options` makes them; their background is also that of RGBA pictures
    quantize8   round renders to 8 bit before comparing; a metric declared with `unrounded` never gets rounded ones
    metrics     names from the registry; None: the usual ones that are installed
    metric_settings     of metrics, group -> key -> value
    masked      pictures were cut out by their masks: metrics declared with `pixelwise` get what is inside alone
    save_to     folder for the renders as PNG, named after the views; None: they are not kept

    A metric that cannot be imported, says CapabilityError (weights missing, say) or breaks is left unknown, with its
    reason. Raises SceneError without a view, UserInputError for settings or weights that are wrong.
    """
    if not views:
        raise SceneError("there is no view to evaluate on")
    wanted = [e for e in chosen_metrics(plugins.metrics, metrics, geometry=False) if MetricInfo.of(e).over == "image"]
    setup = MetricSetup(device, metric_settings or {})
    ready: dict[str, PreparedMetric] = {}
    missing: dict[str, str] = {}
    for entry in wanted:
        with noting_failure(entry, missing):
            ready[entry.name] = prepare_metric(entry, setup)
    values: dict[str, list[float]] = {entry.name: [] for entry in wanted}
    visible = drawn = 0
    names = png_names([view.name for view in views])
    pending: list[Future[None]] = []
    if save_to is not None:
        save_to.mkdir(parents=True, exist_ok=True)
    with track(label, total=len(views), unit="views") as bar, ThreadPoolExecutor(1) as writer:
        for view, file_name in zip(views, names, strict=True):
            result = render_view(model, view.camera.to(device), rasterizer, options)
            image = prepare_render(result.image, quantize8=quantize8)
            exact = prepare_render(result.image, quantize8=False)
            truth = view.image(options.background, device)
            inside = view.mask.to(device) if masked and view.mask is not None else None
            for entry in (e for e in wanted if e.name not in missing):
                pair = exact if MetricInfo.of(entry).unrounded else image, truth
                if inside is not None and MetricInfo.of(entry).pixelwise:
                    pair = pair[0][:, None, inside], truth[:, None, inside]
                with noting_failure(entry, missing):
                    values[entry.name].append(measured(entry, ready[entry.name], *pair))
            visible += int(result.visible.sum())
            drawn += len(result.inputs)
            if save_to is not None:
                pending.append(writer.submit(save_png, image.cpu(), save_to / file_name))
            so_far = values.get("psnr")
            bar.advance(1, **({"PSNR": sum(so_far) / len(so_far)} if so_far else {}))
    for written in pending:
        written.result()  # a full disk must not pass unseen
    return EvaluationResult(
        views=[view.name for view in views],
        metrics={e.name: _summary(e, values[e.name], ready.get(e.name), missing.get(e.name)) for e in wanted},
        visible_gaussians=visible / len(views),
        drawn_gaussians=drawn / len(views),
        renders=names if save_to is not None else [],
    )


def evaluate_model(subject: Subject, entries: Sequence[Entry]) -> dict[str, MetricResult]:
    """Measure by those over views and models that apply to it; one that breaks or lacks something only has a reason."""
    found = {}
    for entry in (e for e in entries if MetricInfo.of(e).over != "image"):
        missing: dict[str, str] = {}
        info = MetricInfo.of(entry)
        with noting_failure(entry, missing):
            if (it := entry.load()(subject)) is not None:
                mean, each, more = json.loads(json.dumps([it.mean, it.per_view, dict(it.details)], allow_nan=False))
                found[entry.name] = MetricResult(mean, each, info.direction, it.reason, info.diagnostic, details=more)
        if missing:
            found[entry.name] = MetricResult(None, [], info.direction, missing[entry.name], info.diagnostic)
    return found


def _summary(entry: Entry, values: list[float], ready: PreparedMetric | None, missing: str | None) -> MetricResult:
    info = MetricInfo.of(entry)
    if ready is None or missing is not None:
        return MetricResult(None, [], info.direction, missing, info.diagnostic)
    finite = [v if math.isfinite(v) else None for v in values]
    reason = NOT_A_NUMBER if any(map(math.isnan, values)) else INFINITE if None in finite else None
    mean = None if reason else sum(values) / len(values)
    return MetricResult(mean, finite, info.direction, reason, info.diagnostic, ready.made_with, ready.verified)


def png_names(views: Sequence[str]) -> list[str]:
    """File names for the renders of views: no folders, and unique also where stems are not."""
    flat = [name.replace("/", "__").replace(os.sep, "__") for name in views]
    stems = [name.rsplit(".", 1)[0] for name in flat]
    count = Counter(stems)
    found: dict[str, None] = {}
    for name, stem in zip(flat, stems, strict=True):
        chosen = stem if count[stem] == 1 else name
        # Also where the one's folder is spelt in the other's name: a/b.png and a__b.png.
        free = itertools.chain([chosen], (f"{chosen}~{n}" for n in itertools.count(2)))
        found[next(candidate for candidate in free if candidate not in found)] = None
    return [f"{name}.png" for name in found]


def save_png(image: Tensor, path: Path) -> None:
    """Write [3,H,W] in 0..1 as 8-bit PNG, atomically."""
    from PIL import Image

    pixels = (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    with replacing(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")
