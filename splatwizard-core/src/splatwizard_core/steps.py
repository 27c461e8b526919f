"""The steps of a run as functions, lent by the package itself (docs/api.md). Options are those of the commands, and
keys of --set with nested ones as dictionaries; what is wrong raises what the commands print."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from splatwizard_core import api, tooling
from splatwizard_core.cli.setup import open_training_session
from splatwizard_core.evaluation import evaluate as quality
from splatwizard_core.runs.encode import encode_directory
from splatwizard_core.runs.measure import Opened, measure, opener
from splatwizard_core.runs.run import train_only
from splatwizard_core.training.keys import dotted


def _choices(options: dict[str, Any], **given: Any) -> tooling.Choices:
    known = {each.name: options.pop(each.name) for each in fields(tooling.Choices) if each.name in options}
    return tooling.Choices(**given, **known, below=dotted(options))


def _training(method: str, scene: str | None, out: str | Path, options: dict[str, Any]) -> Any:
    chosen = _choices(options, methods=(method,), scene=scene)
    resolved, session = open_training_session(chosen, tooling.load_plugins())
    if len(resolved) != 1:
        raise api.ConfigError("one call trains one method for one rate point; call it once for each", key="rate")
    return session, tooling.RunRequest(resolved[0], Path(out))


def _session(options: dict[str, Any], scene: str | None = None) -> Any:
    resolved = _choices(options, scene=scene).resolve_without_method()
    return tooling.open_session(resolved, tooling.load_plugins()), resolved


def run(method: str, scene: str | None = None, out: str | Path = "out", **options: Any) -> tooling.Record:
    """Train, encode, decode in a fresh process, evaluate; returns the record, which metrics.json holds."""
    return tooling.run(*_training(method, scene, out, options))[0]


def train(method: str, scene: str | None = None, out: str | Path = "out", **options: Any) -> tuple[Opened, Path]:
    """Train, or load what is trained; returns the model with what it asks of a rasterizer, and the run directory."""
    trained, directory = train_only(*_training(method, scene, out, options))
    return Opened(trained.model.eval().requires_grad_(False), trained.facts.raster), directory


def encode(directory: str | Path, file: str | Path, **options: Any) -> Path:
    """Encode the trained model of a run directory into a file; `rate` and keys of the codec change how."""
    chosen = _choices(options).with_rate_of(Path(directory), tooling.load_plugins())
    resolved = chosen.resolve_one(tooling.load_plugins())
    session = tooling.open_session(resolved, tooling.load_plugins())
    encode_directory(session, resolved, Path(directory), Path(file))
    return Path(file)


def decode(file: str | Path, **options: Any) -> Opened:
    """Decode a .swz from nothing but itself, or read a .ply: the model, and what it asks of a rasterizer."""
    return opener(Path(file), _session(options)[0])()


def load_scene(scene: str | None = None, **options: Any) -> api.Scene:
    """Load a scene as a run reads it: views to train and to test on, and start points."""
    session, resolved = _session(options, scene)
    return session.scene(resolved)  # type: ignore[no-any-return]


def evaluate(source: Opened | str | Path, scene: str | None = None, *, speed: bool = False, **options: Any) -> Any:
    """Measure a file, or what `decode` and `train` return, on the test views: the facts of `sw eval --json`."""
    if isinstance(source, Opened):
        options.setdefault("device", source.model.device.type)
    chosen = _choices(options, scene=scene)
    resolved = (chosen if isinstance(source, Opened) else chosen.of_file(Path(source))).resolve_without_method()
    session = tooling.open_session(resolved, tooling.load_plugins())
    open_it = (lambda: source) if isinstance(source, Opened) else opener(Path(source), session)
    return measure(session, resolved, open_it, speed=speed).model_dump(mode="json")


def render(opened: Opened, view: api.View, **options: Any) -> api.RenderResult:
    """Draw a view: `image` [3,H,W] in 0..1, and the maps that `options`, those of RasterOptions, ask for."""
    session, resolved = _session({"device": opened.model.device.type})
    rasterizer = session.rasterizer(resolved, quality.suggested_rasterizers(opened.raster))
    asked = replace(quality.render_options(opened.raster, None), **options)
    found = quality.render_view(opened.model, view.camera.to(session.device), rasterizer, asked)
    rasterizer.look(found)
    return found
