"""The viewer's server, on viser: browsers connect, move, and are sent pictures that this machine draws.

All drawing happens in the thread that calls `pump`: no lock is needed, and a training can draw between its steps.
"""

from __future__ import annotations

import contextlib
import io
import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from splatwizard_core.api import Camera, CapabilityError
from splatwizard_core.tooling import ForeseenError
from sw_view.browser_session import ELLIPSOIDS, NOTHING, SPLATS, BrowserSession
from sw_view.frames import REST, Pixels, orientation_of, side_by_side
from sw_view.shown_cameras import Surroundings
from sw_view.shown_gaussians import ShownGaussians, sphere
from sw_view.shown_models import ShownModel

if TYPE_CHECKING:
    import viser

INSTALL = "pip install 'sw-view[viser]'"
QUALITY_MOVING, QUALITY_STILL = 70, 92  # JPEG


def start_server(host: str, port: int) -> viser.ViserServer:
    """Start viser's server. Raises CapabilityError where viser is missing or cannot be imported."""
    try:
        import viser
    except ImportError as error:
        told = f"sw view needs the package viser ({error}): {INSTALL}, or write a page with --html FILE.html"
        raise CapabilityError(told, missing=["viser"]) from error
    # It tells every connection; only what goes wrong is for the user.
    for name in ("websockets.server", "viser"):
        logging.getLogger(name).setLevel(logging.ERROR)
    with contextlib.redirect_stdout(io.StringIO()):  # it prints a box of addresses, whatever `verbose` says
        return viser.ViserServer(host=host, port=port, label="Splatwizard", verbose=False)


def stop_server(server: viser.ViserServer) -> None:
    """Close all connections and the port."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


class Viewer:
    """Shows models to all browsers that connect.

    server      of `start_server`
    around      cameras and the direction that is up
    labels      of the models; the first is what a browser sees at first
    open_label  (label) -> the model, called when somebody first looks at it
    background  [3] in 0..1, behind what the browser draws by itself
    """

    def __init__(
        self, server: viser.ViserServer, around: Surroundings, labels: Sequence[str],
        open_label: Callable[[str], ShownModel], background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:  # fmt: skip
        self.server, self._around, self._labels, self._open = server, around, tuple(labels), open_label
        self._ground = np.round(255 * np.array(background)).astype(np.uint8)
        self._shown_models: dict[str, ShownModel] = {}
        self._sessions: dict[int, BrowserSession] = {}
        self._awake = threading.Condition()
        self._woken = False
        self.generation = 0
        self.pictures = 0
        self.note = ""
        server.scene.set_up_direction(around.up)
        server.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        shown = server.gui.add_checkbox("Show cameras", initial_value=False)
        frusta = self._frusta()

        def show_or_hide(_event: object) -> None:
            for each in frusta:
                each.visible = shown.value

        shown.on_update(show_or_hide)
        server.on_client_connect(self._enter)
        server.on_client_disconnect(self._leave)

    @property
    def address(self) -> str:
        """URL that a browser on this machine opens."""
        host = self.server.get_host()
        return f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{self.server.get_port()}"

    @property
    def watched(self) -> bool:
        """Whether a browser is connected."""
        return bool(self._sessions)

    def pump(self, wait: float) -> None:
        """Draw what browsers wait for; sleep up to `wait` seconds while there is nothing to draw."""
        until = time.monotonic() + wait
        while True:
            with self._awake:
                self._woken = False
            for session in list(self._sessions.values()):
                key = session.due(self.generation, time.monotonic())
                if key is not None:
                    self._serve(session, key)
            now = time.monotonic()
            resting = [v.moved_at + REST for v in list(self._sessions.values()) if v.drawn[2] < 1]
            upto = min([until, *resting])
            with self._awake:
                if not self._woken and upto > now:
                    self._awake.wait(upto - now)
                woken = self._woken
            if not woken and time.monotonic() >= until:
                return
            if wait == 0:
                return

    def renew(self, label: str) -> None:
        """Open a model again, for all who look at it: its file has changed."""
        self._shown_models.pop(label, None)
        self.generation += 1

    def stop(self) -> None:
        """Close all connections and the port."""
        stop_server(self.server)

    def wake(self) -> None:
        """Let a sleeping `pump` look for work; from any thread."""
        with self._awake:
            self._woken = True
            self._awake.notify_all()

    def _enter(self, client: viser.ClientHandle) -> None:
        self._sessions[client.client_id] = BrowserSession(client, self._around, self._labels, self.wake)
        self.wake()

    def _leave(self, client: viser.ClientHandle) -> None:
        self._sessions.pop(client.client_id, None)

    def _shown_model(self, name: str) -> ShownModel:
        if name not in self._shown_models:
            self._shown_models[name] = self._open(name)
        return self._shown_models[name]

    def _serve(self, session: BrowserSession, key: tuple[int, int, float]) -> None:
        began = time.monotonic()
        try:
            self._show(session, key)
        except (ForeseenError, OSError, RuntimeError) as error:  # also a full GPU, or a file that was taken away
            session.told.content = f"**{error}**"
            key = (*key[:2], 1.0)  # it would fail in full, too
        session.drawn = key
        session.pace.drew(key[2], time.monotonic() - began)

    def _show(self, session: BrowserSession, key: tuple[int, int, float]) -> None:
        share = key[2]
        camera = session.camera(share)
        left = self._shown_model(session.model.value)
        if session.browser_draws is not None:
            self._hand_over(session, left, camera)
        else:
            session.clear()
            began = time.monotonic()
            pixels = self._drawn(session, left, camera)
            seconds = time.monotonic() - began
            quality = QUALITY_STILL if share == 1 else QUALITY_MOVING
            session.client.scene.set_background_image(pixels, format="jpeg", jpeg_quality=quality)
            size = f"{camera.width} x {camera.height} in {1000 * seconds:.0f} ms"
            beside = session.beside.value
            second = "" if beside == NOTHING else f"right: {self._shown_model(beside).told()}"
            session.told.content = "  \n".join(filter(None, [self.note, left.told(), second, size]))
        self.pictures += 1

    def _drawn(self, session: BrowserSession, left: ShownModel, camera: Camera) -> Pixels:
        mode, split = session.mode.value, session.split.value
        if session.beside.value == NOTHING or split >= 1:
            return left.draw(camera, mode)
        right = self._shown_model(session.beside.value).draw(camera, mode)
        return right if split <= 0 else side_by_side(left.draw(camera, mode), right, split)

    def _hand_over(self, session: BrowserSession, shown: ShownModel, camera: Camera) -> None:
        """Let the browser draw; the Gaussians are sent again only when there are others."""
        kind = session.browser_draws
        wanted = (kind, session.model.value, session.sigmas.value, self.generation)
        if session.held_for == wanted:
            return
        session.clear()
        session.ground(self._ground)
        found = shown.gaussians(camera)
        if kind == SPLATS:
            node = session.client.scene.add_gaussian_splats(
                "/splats", found.means, found.covariances, found.colors / np.float32(255), found.opacities
            )
            note = f"{len(found.means):,} Gaussians, drawn by the browser with the colours of SH band 0"
            session.held = [node]
        else:
            solid = found.largest()
            session.held = [self._ellipsoids(session, solid)] if len(solid.means) else []
            note = f"the {len(solid.means):,} of {len(found.means):,} Gaussians that cover most, as ellipsoids"
        session.held_for = wanted
        session.told.content = "  \n".join(filter(None, [self.note, shown.told(), note]))

    def _ellipsoids(self, session: BrowserSession, solid: ShownGaussians) -> viser.SceneNodeHandle:
        vertices, faces = sphere()
        return session.client.scene.add_batched_meshes_simple(
            f"/{ELLIPSOIDS}", vertices, faces, solid.quats, solid.means,
            batched_scales=solid.scales * np.float32(session.sigmas.value), lod="off",
            batched_colors=_lit(solid.colors), cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _frusta(self) -> list[viser.CameraFrustumHandle]:
        found = []
        for i, each in enumerate(self._around.cameras):
            camera = each.camera
            frustum = self.server.scene.add_camera_frustum(
                f"/cameras/{i}", camera.fov_y, camera.width / camera.height, scale=0.04 * self._around.size,
                thickness=0.004 * self._around.size, color=(230, 120, 30), visible=False,
                wxyz=orientation_of(camera), position=camera.center.cpu().numpy(),
            )  # fmt: skip

            def jump(event: viser.SceneNodePointerEvent[viser.CameraFrustumHandle], name: str = each.name) -> None:
                session = self._sessions.get(event.client.client_id)
                if session is not None:
                    session.cameras.value = name
                    session.go_to(session.named(name))

            frustum.on_click(jump)
            found.append(frustum)
        return found


def _lit(colors: Pixels) -> Pixels:
    """Darken colours for the lights of viser, which would bleach them."""
    lit: Pixels = (0.8 * 255 * (colors / 255.0) ** 2).astype(np.uint8)
    return lit
