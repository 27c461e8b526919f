"""Measure an encoded file: quality, speed, memory. Meant for a process that did nothing else before."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch

from splatwizard_core.base.machine import describe_machine
from splatwizard_core.base.memory import MemoryMeter, synchronize
from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.coding.cuts import WHOLE, Prefix
from splatwizard_core.evaluation import evaluate as quality
from splatwizard_core.evaluation.metrics import MetricSetup, chosen_metrics
from splatwizard_core.evaluation.speed import SpeedBlock, SpeedReport, measure_speed
from splatwizard_core.gaussians.placement import placed_in
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.plugins import PluginManager
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import ResolvedConfig
from splatwizard_core.runs.decode import import_method, open_model, read_gaussians
from splatwizard_core.runs.facts import Measurement, contention
from splatwizard_core.runs.record import MemoryBlock, MetricBlock, PrefixBlock, ProtocolBlock
from splatwizard_core.runs.session import Session
from splatwizard_core.runs.training_views import training_psnr
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import Scene
from splatwizard_native import CoreTime, loading_time, work_time

FEWEST_SPEED_VIEWS = 8


class Opened(NamedTuple):
    """A model on its device, and the facts of the file that it came from.

    raster          options that it asks of a rasterizer
    device_bound    its file decodes only on the machine that made it
    static          values of its file's header
    """

    model: SplatModel
    raster: dict[str, Any]
    device_bound: bool = False
    static: dict[str, Any] = {}


def measure(
    session: Session,
    resolved: ResolvedConfig,
    open_model: Callable[[], Opened],
    *,
    metrics: Sequence[str] | None = None,
    geometry: bool = False,
    speed: bool = True,
    repeats: int = 1,
    renders: Path | None = None,
) -> Measurement:
    """Open a model, then its scene, and measure the one on the other.

    resolved    with the scene, the settings of metrics, and the choice of rasterizers
    open_model  () -> the model on the session's device; called first, before any picture is read
    metrics     names; None: the usual ones over images, and PSNR over the training views where `eval_train`
                asks for it; with `geometry` all over models besides
    speed       also measure speed and memory
    repeats     how often speed is measured
    renders     folder for the test views as PNG, and in `geometry` what metrics over models show; None: not kept
    """
    plugins, device = session.plugins, session.device
    meter = MemoryMeter(device)
    meter.start()
    began = work_time()
    model, raster, device_bound, static = open_model()
    synchronize(device)
    open_s = work_time() - began
    decoded_bytes, peak_load = meter.current_bytes(), meter.peak_bytes()
    bad_rows = model.check_finite() + sum(getattr(model, "origin", {}).get("left_out", {}).values())
    scene = session.scene(resolved)
    placed_in(model, scene)
    options = quality.render_options(raster, scene.background.to(device))
    rasterizer = session.rasterizer(resolved, quality.suggested_rasterizers(raster))
    views = scene.test

    meter.start()
    began = work_time()
    with torch.no_grad():
        model.prepare()
    synchronize(device)
    prepare_s = work_time() - began
    # CUDA's allocator knows all that is held; a resident set only grows by what was measured piece by piece.
    model_bytes = meter.current_bytes() if meter.kind == "cuda" else decoded_bytes + meter.current_bytes()

    def draw(with_: NegotiatedRasterizer) -> Callable[[Camera], torch.Tensor]:
        return lambda camera: quality.render_view(model, camera, with_, options).image

    report: SpeedReport | None = None
    contended: dict[str, float] = {}
    drawn: dict[str, Any] = {}
    speed_views = views
    if len(views) < FEWEST_SPEED_VIEWS:
        tested = {view.name for view in views}
        speed_views = [*views, *(view for view in scene.train if view.name not in tested)]
    if speed and speed_views:
        cameras, cores = [view.camera.to(device) for view in speed_views], CoreTime()
        report = measure_speed(draw(rasterizer), cameras, device, repeats=repeats)
        contended = contention("render", cores)
        drawn |= {"drawn_by": rasterizer.drawn_by}
        default = session.rasterizer(resolved, ())
        draw(default)(cameras[0])
        if set(default.drawn_by.values()) != set(rasterizer.drawn_by.values()):  # methods are compared by one
            fps = measure_speed(draw(default), cameras, device, repeats=repeats).fps
            drawn |= {"default_fps": {"+".join(sorted(set(default.drawn_by.values()))): fps}}
    result = quality.evaluate(
        model, views, rasterizer, plugins,
        device=device, options=options, quantize8=scene.protocol.quantize8, metrics=metrics,
        metric_settings=resolved.metrics, masked=scene.protocol.masked, save_to=renders,
        label=f"evaluate on {scene.name}",
    )  # fmt: skip
    setup = MetricSetup(device, resolved.metrics)
    subject = quality.Subject(model, scene, rasterizer, options, setup, static, renders and renders / "geometry")
    of_model = quality.evaluate_model(subject, chosen_metrics(plugins.metrics, metrics, geometry=geometry))
    results = {**result.metrics, **of_model}.items()
    of_training, reasons = None, {"training_psnr": "not asked for (eval_train, --metrics)"}
    if metrics is None and resolved.ppl.eval_train:  # last: the pictures are read for it alone
        of_training, reasons = training_psnr(scene, draw(rasterizer), device)
    speeds, memory = None, None
    if report is not None:
        first = speed_views[0].camera
        told = report.model_dump() | drawn | {
            "jit_s": loading_time(),
            "prepare_s": prepare_s,
            "load_s": open_s + prepare_s + report.first_frame_s,
            "image_size": [first.width, first.height],
            "kind": report.memory_kind,
            "model_bytes": model_bytes,
            "peak_load_bytes": peak_load,
            "peak_render_bytes": report.peak_bytes + (0 if report.memory_kind == "cuda" else model_bytes),
        }  # fmt: skip
        speeds, memory = SpeedBlock.model_validate(told), MemoryBlock.model_validate(told)
    return Measurement(
        dataset=scene.protocol.dataset, scene=scene.name, scene_warnings=list(scene.warnings),
        scene_origin=scene.origin, train_views=len(scene.train), test_views=len(views), views=result.views,
        protocol=ProtocolBlock.model_validate({"id": scene.protocol.id, **asdict(scene.protocol)}),
        metrics={name: MetricBlock.model_validate(asdict(metric)) for name, metric in results},
        visible_gaussians=result.visible_gaussians, drawn_gaussians=result.drawn_gaussians, renders=result.renders,
        geometry={name: dict(m.details) for name, m in of_model.items() if not m.per_view} or None,
        training_psnr=of_training, digest=model.digest(), counts=model.counts(), speed=speeds, memory=memory,
        unknown={f"metrics.{name}.mean": m.reason for name, m in results if m.reason is not None} | reasons,
        rasterizers=dict(rasterizer.choices), raster=quality.raster_header(rasterizer.decided(options)),
        environment=_environment(plugins, device, resolved.ppl.seed), contended=contended,
        flags=_flags(scene, result, meter, device_bound=device_bound, bad_rows=bad_rows, contended=bool(contended)),
    )  # fmt: skip


def _environment(plugins: PluginManager, device: torch.device, seed: int) -> dict[str, Any]:
    """Return plain values for the record: no machine name, no path, no user."""
    packages = {p.distribution: p.version for p in plugins.plugins}
    for name in ("torch", "numpy"):
        packages[name] = importlib.metadata.version(name)
    return {"packages": packages, "seed": seed, **describe_machine(device)}


def _flags(
    scene: Scene, result: quality.EvaluationResult, meter: MemoryMeter, *, device_bound: bool, bad_rows: int,
    contended: bool,
) -> list[str]:  # fmt: skip
    """Name the circumstances that a reader of the numbers must know."""
    told = {
        "fit": scene.protocol.split == "all",
        "rss": meter.kind == "rss",
        "infinite": any(metric.reason == quality.INFINITE for metric in result.metrics.values()),
        "not-a-number": any(metric.reason == quality.NOT_A_NUMBER for metric in result.metrics.values()),
        "unverified-weights": not all(metric.verified for metric in result.metrics.values()),
        "device-bound": device_bound,
        "non-finite-rows": bad_rows > 0,
        "contended": contended,
    }
    return [name for name, holds in told.items() if holds]


def opener(path: Path, session: Session, prefix: Prefix = WHOLE) -> Callable[[], Opened]:
    """Return a function that opens the model of a .swz, .ply or other file of Gaussians on the session's device."""
    encoded = session.plugins.importers.of_suffix(path) is None

    def open_file() -> Opened:
        if not encoded:
            gaussians = read_gaussians(path, session.plugins)
            raster = gaussians.origin.get("raster", {})
            return Opened(gaussians.to(session.device).eval().requires_grad_(False), raster)
        model, reader = open_model(path, session.plugins, session.device, prefix=prefix)
        return Opened(model, reader.raster, reader.made_on is not None, reader.static)

    if encoded:
        import_method(path, session.plugins, prefix)  # code is not memory of the model
    return open_file


def measure_prefixes(
    session: Session, resolved: ResolvedConfig, path: Path, metrics: Sequence[str]
) -> list[PrefixBlock]:
    """Measure a file at each of its cuts that is there; nothing for a file without cuts."""
    reader, found = ContainerReader.open(path), []
    for cut in reader.summary()["cuts"][: reader.packets]:
        part = opener(path, session, Prefix(cut["packets"]))
        measured = measure(session, resolved, part, metrics=metrics, speed=False)
        means = {name: metric.mean for name, metric in measured.metrics.items() if metric.mean is not None}
        found.append(PrefixBlock(packets=cut["packets"], bytes=cut["bytes"], counts=measured.counts, metrics=means))
    return found


def open_subject(path: Path, session: Session, resolved: ResolvedConfig, scene: Scene | None = None) -> quality.Subject:
    """Open a model, then its scene (None: the configured one); what draws it is as the run and the file ask."""
    model, raster, _, static = opener(path, session)()
    model.check_finite()
    scene = scene or session.scene(resolved)
    placed_in(model, scene, path.name)
    rasterizer = session.rasterizer(resolved, quality.suggested_rasterizers(raster))
    with torch.no_grad():
        model.prepare()
    options = quality.render_options(raster, scene.background.to(session.device))
    return quality.Subject(model, scene, rasterizer, options, MetricSetup(session.device, resolved.metrics), static)
