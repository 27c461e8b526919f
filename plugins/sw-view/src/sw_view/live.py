"""A training that can be looked at: `sw train --view`, or `--set log.view=PORT`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch

from splatwizard_core.api import Camera, RasterOptions, SplatModel
from splatwizard_core.tooling import NegotiatedRasterizer, StartedTraining, say
from sw_view.drawing import Drawing
from sw_view.mode_pictures import mode_picture
from sw_view.shown_cameras import surroundings_of
from sw_view.shown_gaussians import shown_gaussians
from sw_view.shown_models import ShownModel
from sw_view.viewer import Viewer, start_server

if TYPE_CHECKING:
    from sw_view.frames import Pixels

HOST = "127.0.0.1"
EVERY = 1.0
"""Least seconds between pictures of a model that trains on while nobody moves."""
REST = 4.0
"""Least time between two drawings, in times of the one before: a fifth of all time is drawn, also for who moves."""


class LiveView:
    """Observer that shows the model between its steps, in the training's own thread; nobody looks: it draws nothing.

    Raises CapabilityError without the package viser.
    """

    def __init__(self, training: StartedTraining, port: int) -> None:
        self._training = training
        self._model: SplatModel | None = None
        self._shown_at = self._rests_until = 0.0
        self._viewer = Viewer(
            start_server(HOST, port),
            surroundings_of(training.scene),
            [training.method],
            lambda _label: self.shown_model,
        )
        self._paused = self._viewer.server.gui.add_checkbox("Pause the training", initial_value=False)
        self._paused.on_update(lambda _event: self._viewer.wake())
        say(f"look at the training at {self._viewer.address}")

    def after_step(self, model: SplatModel, record: Any) -> None:
        """Draw now and then, soonest for browsers that moved; stay here while one of them pauses."""
        now = time.monotonic()
        if not self._viewer.watched or (now < self._rests_until and not self._paused.value):
            return
        self._model = model
        if now - self._shown_at >= EVERY or self._paused.value:
            self._shown_at = now
            self._viewer.generation += 1
            loss = float(record.total)
            self._viewer.note = (
                f"{record.stage_name}: step {record.step:,} of {record.iterations:,}, loss {loss:.4f}, "
                f"{record.num_rows:,} {model.ROW_LABEL}"
            )
        self._viewer.pump(0)
        ended = time.monotonic()
        self._rests_until = ended + REST * (ended - now)
        while self._paused.value and self._viewer.watched:
            self._viewer.pump(0.2)

    def finished(self) -> None:
        """Close the port."""
        self._viewer.stop()

    @property
    def shown_model(self) -> ShownModel:
        """The model of the last step, drawn as it would be after the training."""
        return ShownModel(self._draw, lambda camera: self._as_decoded(shown_gaussians, camera), lambda: "")

    def _draw(self, camera: Camera, mode: str) -> Pixels:
        model, rasterizer = self._model, self._training.rasterizer
        assert model is not None
        assert isinstance(rasterizer, NegotiatedRasterizer)  # a session has no other
        options = RasterOptions(background=self._training.scene.background.to(model.device))
        drawing = Drawing(model, self._training.scene, rasterizer, options, model.device)
        with _as_found(model):
            return mode_picture(drawing, camera, mode)

    def _as_decoded(self, call: Callable[..., Any], camera: Camera) -> Any:
        assert self._model is not None
        with _as_found(self._model):
            return call(self._model, camera, self._training.rasterizer)


@contextmanager
def _as_found(model: SplatModel) -> Iterator[None]:
    """Let a model be drawn in evaluation mode; the mode and torch's random stream are left as they were."""
    was = model.training
    model.eval()
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        model.train(was)
