"""A stand-in for viser's server: keeps what it is told, so that the viewer's own logic is tested without it."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace
from typing import Any

import numpy as np


class Handle(SimpleNamespace):
    """A control, a node or a camera: attributes, and functions that a test calls as a browser would."""

    def __init__(self, **values: Any) -> None:
        super().__init__(visible=True, removed=False, listeners=[], **values)

    def on_update(self, function: Any) -> None:
        self.listeners.append(function)

    on_click = on_update

    def remove(self) -> None:
        self.removed = True

    def say(self, event: Any = None, **values: Any) -> None:
        """Let a browser change it."""
        vars(self).update(values)
        for each in list(self.listeners):
            each(event)


class Gui:
    def configure_theme(self, **_options: Any) -> None: ...

    def add_dropdown(self, label: str, options: Any, **values: Any) -> Handle:
        return Handle(label=label, options=tuple(options), value=values.get("initial_value", options[0]))

    def add_slider(self, label: str, _low: float, _high: float, _step: float, value: float, **_: Any) -> Handle:
        return Handle(label=label, value=value)

    def add_checkbox(self, label: str, initial_value: bool) -> Handle:
        return Handle(label=label, value=initial_value)

    def add_markdown(self, content: str) -> Handle:
        return Handle(content=content)


class Scene:
    def __init__(self) -> None:
        self.pictures: list[np.ndarray] = []
        self.nodes: list[tuple[str, Handle, dict[str, Any]]] = []
        self.up: Any = None

    def set_up_direction(self, up: Any) -> None:
        self.up = up

    def set_background_image(self, image: np.ndarray, **_options: Any) -> None:
        self.pictures.append(image)

    def _add(self, name: str, *arguments: Any, **options: Any) -> Handle:
        node = Handle(name=name)
        self.nodes.append((name, node, {**options, "arguments": arguments}))
        return node

    add_gaussian_splats = add_batched_meshes_simple = add_camera_frustum = _add


class Client:
    def __init__(self, number: int, size: tuple[int, int]) -> None:
        self.client_id, self.gui, self.scene = number, Gui(), Scene()
        width, height = size
        self.camera = Handle(
            wxyz=np.array([1.0, 0, 0, 0]), position=np.zeros(3), fov=1.0, look_at=None, up_direction=None,
            image_width=width, image_height=height, aspect=width / height,
        )  # fmt: skip

    atomic = staticmethod(contextlib.nullcontext)


class Server:
    def __init__(self) -> None:
        self.gui, self.scene, self.stopped = Gui(), Scene(), False
        self.clients = 0

    def on_client_connect(self, function: Any) -> None:
        self._connect = function

    def on_client_disconnect(self, function: Any) -> None:
        self.disconnect = function

    def connect(self, size: tuple[int, int] = (64, 48)) -> Client:
        client = Client(self.clients, size)
        self.clients += 1
        self._connect(client)
        return client

    def get_host(self) -> str:
        return "127.0.0.1"

    def get_port(self) -> int:
        return 8080

    def stop(self) -> None:
        self.stopped = True
