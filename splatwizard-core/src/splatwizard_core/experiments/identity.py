"""What makes two scenes the same scene, for keys of cached and finished work."""

from __future__ import annotations

import hashlib

import torch
from torch import Tensor

from splatwizard_core.scene.scene import Scene

SAMPLED_PICTURES = 8


def scene_digest(scene: Scene) -> str:
    """SHA-256 over protocol, view names, cameras, start points, and the pixels of eight evenly spread training views.

    All pictures would be surer, but reading thousands of megapixels to learn that nothing is to be done costs minutes;
    a scene that keeps every camera, point and sampled picture and differs elsewhere does not arise by accident.
    """
    sha = hashlib.sha256(f"{scene.name}\n{scene.protocol.id}\n".encode())

    def add(tensor: Tensor) -> None:
        sha.update(f"{tuple(tensor.shape)}{tensor.dtype}".encode())
        sha.update(tensor.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes())

    for part in (scene.train, scene.test):
        for view in part:
            c = view.camera
            sha.update(f"{view.name}\n{c.width} {c.height} {c.fx!r} {c.fy!r} {c.cx!r} {c.cy!r}\n".encode())
            add(c.R)
            add(c.tau)
    if scene.points is not None:
        add(scene.points.xyz)
        if scene.points.rgb is not None:
            add(scene.points.rgb)
    count = min(SAMPLED_PICTURES, len(scene.train))
    for i in range(count):
        view = scene.train[i * len(scene.train) // count]
        if view.load is not None:
            add(view.pixels)
    return sha.hexdigest()
