"""The cameras of a scene from above, those to train on and those held out, as an SVG picture."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import Camera, Scene, SceneError
from sw_datasets.sectors import plan_of, poses_of

SIDE, MARGIN, HEAD = 480, 24, 44  # pixels: of the square, around the cameras, above them
TICK = 11  # pixels: of the line that shows where a camera looks
COLOURS = {"train": "#2a6fb0", "test": "#d9660b"}

Floats = NDArray[np.float64]


def plan_view(scene: Scene) -> str:
    """An SVG picture of the cameras seen from above; a line shows where each looks.

    Above is the cameras' mean up direction. Where they stand about no place, the widest direction lies across.
    """
    both = scene.protocol.split == "all"
    parts = {"test": scene.test} if both else {"train": scene.train, "test": scene.test}
    cameras = [view.camera for views in parts.values() for view in views]
    across, along = plan_axes(cameras)
    centres, directions, _ = poses_of(cameras)
    places = np.stack([centres @ across, centres @ along], axis=1)
    ways = np.stack([directions @ across, directions @ along], axis=1)
    low, high = places.min(axis=0), places.max(axis=0)
    scale = (SIDE - 2 * MARGIN) / (float((high - low).max()) or 1.0)
    drawn = (places - (low + high) / 2) * scale * [1, -1] + [SIDE / 2, SIDE / 2 + HEAD]  # pixels, y downwards
    title = html.escape(f"{scene.name}, split {scene.protocol.split}")
    counts = ", ".join(f"{len(views)} {'tested' if name == 'test' else 'trained'}" for name, views in parts.items())
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {SIDE} {SIDE + HEAD}" width="{SIDE}" '
        f'height="{SIDE + HEAD}" font-family="sans-serif" font-size="13">',
        f"<title>{title}: {counts}</title>",
        '<rect width="100%" height="100%" fill="#ffffff"/>',
        f'<text x="{MARGIN}" y="18" fill="#222222">{title}</text>',
    ]
    x, row = MARGIN, 0
    for name, views in parts.items():
        label = ("trained and tested" if both else "held out") if name == "test" else "trained"
        lines.append(f'<circle cx="{x + 4}" cy="33" r="4" fill="{COLOURS[name]}"/>')
        lines.append(f'<text x="{x + 13}" y="38" fill="#222222">{len(views)} {label}</text>')
        x += 120
        lines.append(f'<g fill="{COLOURS[name]}" stroke="{COLOURS[name]}">')
        for (u, v), (du, dv) in zip(drawn[row : row + len(views)], ways[row : row + len(views)], strict=True):
            lines.append(f'<path d="M{u:.1f} {v:.1f}l{TICK * du:.1f} {-TICK * dv:.1f}"/>')
            lines.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="3"/>')
        lines.append("</g>")
        row += len(views)
    return "\n".join([*lines, "</svg>", ""])


def plan_axes(cameras: Sequence[Camera]) -> tuple[Floats, Floats]:
    """Two orthogonal unit axes [3] of the plane that is seen from above."""
    try:
        plan = plan_of(cameras)
        return plan.across, plan.along
    except SceneError:
        centres, directions, ups = poses_of(cameras)
        spread = np.cov((centres - centres.mean(axis=0)).T) if len(centres) > 1 else np.zeros((3, 3))
        up = ups.mean(axis=0)
        up = up / (np.linalg.norm(up) or 1.0)
        flat = np.eye(3) - np.outer(up, up)
        across = np.linalg.eigh(flat @ spread @ flat)[1][:, -1]
        across = flat @ across
        if np.linalg.norm(across) < 1e-9:  # they stand above each other, or at one place
            across = np.cross(up, directions[0])
        across = across / (np.linalg.norm(across) or 1.0)
        return across, np.cross(up, across)
