"""A browser that is connected to the viewer: its panel, the camera that it moves, and what it was last sent."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from splatwizard_core.api import Camera
from sw_view.frames import Pace, camera_at, frame_size, orientation_of
from sw_view.mode_pictures import MODES, PICTURE
from sw_view.shown_cameras import NamedCamera, Surroundings

if TYPE_CHECKING:
    import viser

ELLIPSOIDS, SPLATS = "ellipsoids", "splats in the browser"
NOTHING = "nothing"


@dataclass
class BrowserSession:
    """State of one browser.

    changed     counts what makes the last picture an old one
    moved_at    seconds of the monotonic clock
    drawn       (changed, generation of the model, share) of the last picture
    """

    client: viser.ClientHandle
    around: Surroundings
    names: Sequence[str]
    wake: Callable[[], None]
    pace: Pace = field(default_factory=Pace)
    changed: int = 1
    moved_at: float = 0.0
    drawn: tuple[int, int, float] = (0, 0, 0.0)
    held: list[Any] = field(default_factory=list)  # nodes of the scene that only this browser has
    held_for: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        gui = self.client.gui
        self.model = gui.add_dropdown("Model", self.names, initial_value=self.names[0], visible=len(self.names) > 1)
        second = self.names[1] if len(self.names) == 2 else NOTHING
        self.beside = gui.add_dropdown(
            "Beside it", (NOTHING, *self.names), initial_value=second, visible=len(self.names) > 1
        )
        self.split = gui.add_slider("Split", 0.0, 1.0, 0.01, 0.5, visible=second != NOTHING)
        self.mode = gui.add_dropdown("Show", (*MODES, ELLIPSOIDS, SPLATS), initial_value=PICTURE)
        self.sigmas = gui.add_slider("Ellipsoids, sigmas", 0.25, 3.0, 0.25, 1.0, visible=False)
        self.cameras = gui.add_dropdown("Camera", tuple(each.name for each in self.around.cameras))
        self.told = gui.add_markdown("")
        for handle in (self.model, self.beside, self.split, self.mode, self.sigmas):
            handle.on_update(lambda _event: self.touch(moved=False))
        self.cameras.on_update(lambda _event: self.go_to(self.named(self.cameras.value)))
        self.client.camera.on_update(lambda _camera: self.touch(moved=True))
        self.go_to(self.around.cameras[0])

    def named(self, name: str) -> NamedCamera:
        """Return the camera of the list that has this name."""
        return next(each for each in self.around.cameras if each.name == name)

    def touch(self, *, moved: bool) -> None:
        """Note that the picture is old; `moved`: the camera moves, so that a small one will do for now."""
        self.beside.visible = len(self.names) > 1 and self.browser_draws is None
        self.split.visible = self.beside.visible and self.beside.value != NOTHING
        self.sigmas.visible = self.mode.value == ELLIPSOIDS
        self.changed += 1
        if moved:
            self.moved_at = time.monotonic()
        self.wake()

    def go_to(self, named: NamedCamera) -> None:
        """Take the place of a camera; its whole picture fits into the window."""
        camera = named.camera
        eye, forward = (v.double().cpu().numpy() for v in (camera.center, camera.R[2]))
        tan_x, tan_y = camera.tan_half_fov
        ahead = max(float((self.around.pivot - eye) @ forward), 0.1 * self.around.size)
        with self.client.atomic():
            self.client.camera.up_direction = -camera.R[1].double().cpu().numpy()
            self.client.camera.position = eye
            self.client.camera.look_at = eye + ahead * forward
            self.client.camera.wxyz = orientation_of(camera)
            self.client.camera.fov = 2 * math.atan(max(tan_y, tan_x / self.client.camera.aspect))

    @property
    def browser_draws(self) -> str | None:
        """`ELLIPSOIDS` or `SPLATS` if the browser draws by itself, else None."""
        return self.mode.value if self.mode.value in (ELLIPSOIDS, SPLATS) else None

    def camera(self, share: float) -> Camera:
        """Return the camera of the browser, at a share of the pixels of its window."""
        seen = self.client.camera
        size = frame_size(seen.image_width, seen.image_height, share)
        return camera_at(seen.wxyz, seen.position, seen.fov, size, self.around.cameras[0].camera.near)

    def due(self, generation: int, now: float) -> tuple[int, int, float] | None:
        """Return the key of the picture to draw now; None if the last one is as good."""
        wanted = (self.changed, generation, self.pace.of(now - self.moved_at))
        old = wanted[:2] != self.drawn[:2] or wanted[2] > self.drawn[2]
        return wanted if old else None

    def clear(self) -> None:
        """Take away the nodes that only this browser has."""
        for node in self.held:
            node.remove()
        self.held, self.held_for = [], ()

    def ground(self, color: np.ndarray) -> None:
        """Show one colour [3] uint8 behind all nodes."""
        self.client.scene.set_background_image(np.full((4, 4, 3), color, np.uint8), format="png")
