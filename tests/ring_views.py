"""Views on a circle, for splits and path distances with closed forms."""

from __future__ import annotations

import math

import torch

from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import View


def ring(count: int, radius: float = 3.0, *, prefix: str = "", offset: float = 0.0, inward: bool = True) -> list[View]:
    """Views in the plane z = 0, counter-clockwise from `offset` degrees, that look at the middle or away from it."""
    return [
        View(camera_at(offset + 360 * i / count, radius, inward=inward), f"{prefix}{i:03d}.png") for i in range(count)
    ]


def camera_at(degrees: float, radius: float, *, inward: bool = True) -> Camera:
    """A camera at an azimuth, z up."""
    turn = math.radians(degrees)
    eye = radius * torch.tensor([math.cos(turn), math.sin(turn), 0.0], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return Camera.look_at(eye, eye * (0 if inward else 2), up, width=16, height=12, fov_x=1.0)
