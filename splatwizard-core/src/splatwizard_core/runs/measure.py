"""Measure an encoded file: quality, speed, memory. Meant for a process that did nothing else before."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch

from splatwizard_core.evaluation.evaluate import (
    INFINITE,
    NOT_A_NUMBER,
    EvaluationResult,
    evaluate,
    png_names,
    render_options,
    render_view,
    save_png,
    suggested_rasterizers,
)
from splatwizard_core.evaluation.metrics import MetricSettings
from splatwizard_core.evaluation.speed import SpeedReport, measure_speed
from splatwizard_core.gaussians.ply import load_ply
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.memory import MemoryMeter, synchronize
from splatwizard_core.plugins import PluginManager
from splatwizard_core.progress import track
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.decode import import_method, open_model
from splatwizard_core.runs.environment import describe_environment
from splatwizard_core.runs.record import MemoryBlock, MetricBlock, SpeedBlock, picked
from splatwizard_core.scene.scene import Scene, View
from splatwizard_core.training.params import PipelineParams

FEWEST_SPEED_VIEWS = 8


class Opened(NamedTuple):
    """A model on its device, and the facts of the file that it came from.

    raster          options that it asks of a rasterizer
    device_bound    its file decodes only on the machine that made it
    """

    model: SplatModel
    raster: dict[str, Any]
    device_bound: bool = False


@dataclass(frozen=True)
class Scope:
    """The extent of a measurement. One that holds more than is asked for is kept: a run that was measured with LPIPS,
    or five times over, does not lose that because a later command does not ask for it.

    repeats     of the speed
    metrics     name -> identity of what its values would depend on now; None: it cannot be computed now
    """

    repeats: int
    metrics: Mapping[str, str | None] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the form that a step remembers."""
        return asdict(self)

    def is_held_by(self, remembered: Any) -> bool:
        """Whether a measurement of extent `remembered` (of `as_dict`, or anything) holds all of this."""
        if not isinstance(remembered, Mapping) or not isinstance(remembered.get("metrics"), Mapping):
            return False
        repeats, metrics = remembered.get("repeats"), remembered["metrics"]
        if not isinstance(repeats, int) or repeats < self.repeats:
            return False
        return all(now is None or metrics.get(name) == now for name, now in self.metrics.items())


def measure(
    open_model: Callable[[], Opened],
    load_scene: Callable[[], Scene],
    plugins: PluginManager,
    device: torch.device,
    ppl: PipelineParams,
    *,
    metrics: Sequence[str] | None = None,
    metric_settings: MetricSettings | None = None,
    speed: bool = True,
    repeats: int = 1,
    renders: Path | None = None,
    load_kernels: Callable[[], None] | None = None,
) -> dict[str, Any]:
    """Open a model, then its scene, and measure the one on the other. Plain values, as `sw eval --json` prints them.

    open_model  () -> the model on `device`; called first, before any picture is read
    load_scene  () -> the scene
    metrics     names; None: all that are installed
    metric_settings     of metrics, group -> key -> value
    speed       also measure speed and memory
    repeats     how often speed is measured
    renders     folder for the test views as PNG; None: not kept
    load_kernels    () -> every native module is loaded or compiled; timed apart, before everything else
    """
    began = time.perf_counter()
    if load_kernels is not None:
        load_kernels()
    jit_s = time.perf_counter() - began

    meter = MemoryMeter(device)
    meter.start()
    began = time.perf_counter()
    model, raster, device_bound = open_model()
    synchronize(device)
    open_s = time.perf_counter() - began
    decoded_bytes, peak_load = meter.current_bytes(), meter.peak_bytes()
    scene = load_scene()
    options = render_options(raster, scene.background.to(device))
    rasterizer = _rasterizer_for(raster, plugins, device, ppl)
    views = scene.test

    meter.start()
    began = time.perf_counter()
    with torch.no_grad():
        model.prepare()
    synchronize(device)
    prepare_s = time.perf_counter() - began
    # CUDA's allocator knows all that is held; a resident set only grows by what was measured piece by piece.
    model_bytes = meter.current_bytes() if meter.kind == "cuda" else decoded_bytes + meter.current_bytes()

    report: SpeedReport | None = None
    speed_views = views if len(views) >= FEWEST_SPEED_VIEWS else _all_views(scene)
    if speed and speed_views:
        cameras = [view.camera.to(device) for view in speed_views]
        report = measure_speed(
            lambda c: render_view(model, c, rasterizer, options).image, cameras, device, repeats=repeats
        )
    quality = evaluate(
        model, views, rasterizer, plugins,
        device=device, options=options, quantize8=scene.protocol.quantize8, metrics=metrics,
        metric_settings=metric_settings, save_to=renders,
        label=f"evaluate on {scene.name}",
    )  # fmt: skip
    found = _describe_scene(scene, quality)
    found |= {
        "digest": model.digest(),
        "counts": model.counts(),
        "speed": None,
        "memory": None,
        "rasterizers": dict(rasterizer.choices),
        "environment": describe_environment(plugins, device, ppl.seed),
        "flags": _flags(scene, quality, meter, device_bound),
    }
    if report is not None:
        first = speed_views[0].camera
        found["speed"] = picked(
            SpeedBlock,
            asdict(report),
            {
                "jit_s": jit_s,
                "prepare_s": prepare_s,
                "load_s": open_s + prepare_s + report.first_frame_s,
                "image_size": [first.width, first.height],
            },
        )
        found["memory"] = picked(
            MemoryBlock,
            asdict(report),
            {
                "kind": report.memory_kind,
                "model_bytes": model_bytes,
                "peak_load_bytes": peak_load,
                "peak_render_bytes": report.peak_bytes + (0 if report.memory_kind == "cuda" else model_bytes),
            },
        )
    return found


def _flags(scene: Scene, quality: EvaluationResult, meter: MemoryMeter, device_bound: bool) -> list[str]:
    """Name the circumstances that a reader of the numbers must know."""
    told = {
        "fit": scene.protocol.split == "all",
        "rss": meter.kind == "rss",
        "infinite": any(metric.reason == INFINITE for metric in quality.metrics.values()),
        "not-a-number": any(metric.reason == NOT_A_NUMBER for metric in quality.metrics.values()),
        "unverified-weights": not all(metric.verified for metric in quality.metrics.values()),
        "device-bound": device_bound,
    }
    return [name for name, holds in told.items() if holds]


def _all_views(scene: Scene) -> list[View]:
    seen = {view.name for view in scene.test}
    return [*scene.test, *(view for view in scene.train if view.name not in seen)]


def _describe_scene(scene: Scene, quality: EvaluationResult) -> dict[str, Any]:
    results = quality.metrics.items()
    return {
        "dataset": scene.protocol.dataset,
        "scene": scene.name,
        "protocol": {"id": scene.protocol.id, **asdict(scene.protocol)},
        "train_views": len(scene.train),
        "test_views": len(scene.test),
        **vars(quality),
        "metrics": {name: picked(MetricBlock, asdict(metric)) for name, metric in results},
        "unknown": {f"metrics.{name}.mean": m.reason for name, m in results if m.reason is not None},
    }


def opener(path: Path, plugins: PluginManager, device: torch.device) -> Callable[[], Opened]:
    """Return a function that opens the model of a .swz or .ply on `device`."""

    def open_file() -> Opened:
        if path.suffix == ".ply":
            return Opened(load_ply(path).to(device).eval().requires_grad_(False), {})
        model, reader = open_model(path, plugins, device)
        return Opened(model, reader.raster, reader.made_on is not None)

    if path.suffix != ".ply":
        import_method(path, plugins)  # code is not memory of the model
    return open_file


def _rasterizer_for(
    raster: dict[str, Any], plugins: PluginManager, device: torch.device, ppl: PipelineParams
) -> NegotiatedRasterizer:
    """Choose what draws a decoded scene: the user's choice first, then the file's."""
    return NegotiatedRasterizer(
        plugins,
        device=device,
        prefer=ppl.raster.prefer,
        forbid=ppl.raster.forbid,
        suggested=suggested_rasterizers(raster),
    )


def render_views(
    opened: Opened,
    views: Sequence[View],
    background: torch.Tensor,
    plugins: PluginManager,
    device: torch.device,
    ppl: PipelineParams,
    folder: Path,
) -> list[str]:
    """Draw views as PNG into `folder`; returns the file names."""
    model = opened.model
    options = render_options(opened.raster, background.to(device))
    rasterizer = _rasterizer_for(opened.raster, plugins, device, ppl)
    folder.mkdir(parents=True, exist_ok=True)
    names = png_names([view.name for view in views])
    model.prepare()
    with track("render", total=len(views), unit="views") as bar:
        for view, name in zip(views, names, strict=True):
            save_png(render_view(model, view.camera.to(device), rasterizer, options).image.cpu(), folder / name)
            bar.advance()
    return names
