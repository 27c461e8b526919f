"""A short training inside a test: of a method, or of stages alone; the PSNR of what came out, and its file.

from sw_kit.short_training import demo, file_of, firings, psnr, train, train_stages
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from splatwizard_core.api import (
    ContainerWriter,
    Method,
    PipelineParams,
    Rasterizer,
    RasterOptions,
    Scene,
    SceneOptions,
    SplatModel,
    Stage,
    stream,
)
from splatwizard_core.tooling import TrainingRun, build_schedulers, load_plugins, load_scene


class Training(NamedTuple):
    """Outcome of a training.

    model   as the last stage left it; its class is the method's own
    losses  for each step the parts of its loss by name, and "total"
    """

    model: Any
    losses: list[dict[str, float]]


def nothing_trained(name: str) -> SplatModel:
    """Raise AssertionError: for a method that starts from nothing."""
    raise AssertionError(f"it asks for a scene trained by '{name}', and was given none")


def demo(points: int = 600) -> Scene:
    """Return the scene `demo:tiny`, with so many start points."""
    return load_scene("demo:tiny", SceneOptions(init_points=points), load_plugins())


def train(
    method: Method,
    scene: Scene,
    rasterizer: Rasterizer,
    *,
    stages: Sequence[Stage] | None = None,
    model: Callable[[], SplatModel] | None = None,
    seed: int = 0,
    **options: Any,
) -> Training:
    """Train a method, or go on with what `directory` holds.

    stages      those of the method, where None
    model       makes the model of step 0; None: the method's, drawn from `seed`
    options     of `train_stages`
    """
    made = model or (lambda: method.create_model(scene, stream(seed, "init")))
    return train_stages(
        method.stages() if stages is None else stages, scene, rasterizer, model=made, seed=seed, **options
    )


def train_stages(
    stages: Sequence[Stage],
    scene: Scene,
    rasterizer: Rasterizer,
    *,
    model: Callable[[], SplatModel] | None = None,
    trained: Callable[[str], SplatModel] = nothing_trained,
    seed: int = 0,
    checkpoint_every: int | None = None,
    directory: Path | None = None,
    stop_after: int | None = None,
    on_step: Callable[[Any, Any], None] | None = None,
) -> Training:
    """Train stages, or go on with what `directory` holds.

    model       makes the model of step 0; None: the first stage starts from a trained scene
    trained     (method name) -> a trained model
    stop_after  write a checkpoint after this step and raise TrainingStopped
    on_step     called after each step with the model and the step's record
    """
    losses: list[dict[str, float]] = []

    def after_step(found: SplatModel, record: Any) -> None:
        parts = {name: float(part) for name, part in record.parts.items()}
        losses.append({**parts, "total": float(record.total)})
        if on_step is not None:
            on_step(found, record)

    outcome = TrainingRun(
        list(stages),
        model or (lambda: nothing_trained("nobody")),
        scene,
        PipelineParams(seed=seed, **({} if checkpoint_every is None else {"checkpoint_every": checkpoint_every})),
        rasterizer,
        directory=directory,
        identity={},
        trained=trained,
        stop_after=stop_after,
        on_step=after_step,
    ).train()
    return Training(outcome.model, losses)


def firings(stage: Stage) -> dict[str, list[int]]:
    """Return for each task of a stage, by name, the steps at which it runs."""
    pre, post = build_schedulers(stage, PipelineParams())
    return {each.name: list(each.fires_in(0, stage.iterations)) for each in (*pre.registrations, *post.registrations)}


@torch.no_grad()
def psnr(model: SplatModel, scene: Scene, rasterizer: Rasterizer) -> float:
    """Return the mean over the training views, dB: enough to see that something was learned."""
    options, values = RasterOptions(background=scene.background), []
    for view in scene.train:
        image = rasterizer.render(model.gaussians(view.camera, rasterizer), view.camera, options).image.clamp(0, 1)
        values.append(-10 * (image - view.image(scene.background)).pow(2).mean().log10())
    return float(torch.stack(values).mean())


@torch.no_grad()
def file_of(method: Method, model: SplatModel) -> bytes:
    """Return the file that the method writes of a model; writing it must not change the model."""
    writer, before = ContainerWriter(method.name, method.version), model.digest()
    method.encode(model, writer)
    assert model.digest() == before, "encode changes the model"
    return writer.to_bytes()
