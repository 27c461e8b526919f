"""Colours for maps, for people: depths along Turbo, normals as the field shows them.

Source: Turbo, A. Mikhailov, "Turbo, an improved rainbow colormap for visualization", Google AI Blog 2019 (Apache-2.0).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Every eighth of its 256 colours; between them, straight lines stay within 3 of 255 of the others.
_TURBO = (
    "30123b 392a73 4040a2 4456c7 466be3 4680f6 4294ff 37a8fa 28bceb 1ccdd8 18ddc2 1fe9af 32f298 4ef97d 6dfe62 8bff4b "
    "a4fc3c b7f735 cbed34 dde037 ecd13a f7c13a fdae35 fe992c fb8122 f56918 ec530f e14109 d23105 c12302 ac1701 950d01 "
    "7a0403"
)
_COLORS = np.array([list(bytes.fromhex(word)) for word in _TURBO.split()], dtype=np.float64)  # [33,3]
ALPHA_MIN = 0.5
"""Pixels with less alpha show no colour of a map."""


def turbo(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the colours [...,3] of values in 0..1; values outside are clamped."""
    place = np.clip(values, 0, 1) * (len(_COLORS) - 1)
    channels = [np.interp(place, np.arange(len(_COLORS)), _COLORS[:, i]) for i in range(3)]
    colors: NDArray[np.uint8] = np.stack(channels, axis=-1).round().astype(np.uint8)
    return colors


def depth_range(depth: NDArray[np.float32], alpha: NDArray[np.float32]) -> tuple[float, float] | None:
    """Return the 2nd and the 98th percentile of the depths [H,W] that are seen; None if none is."""
    seen = (depth > 0) & (alpha >= ALPHA_MIN)
    if not seen.any():
        return None
    low, high = np.percentile(depth[seen], [2, 98])
    return float(low), float(high)


def depth_colors(
    depth: NDArray[np.float32], alpha: NDArray[np.float32], span: tuple[float, float] | None = None
) -> NDArray[np.uint8]:
    """Return [H,W,3]: the depths of a span along Turbo; black where nothing is seen.

    depth   [H,W], 0: no surface
    alpha   [H,W]
    span    depths of the first and the last colour; None: `depth_range` of these
    """
    colors = np.zeros((*depth.shape, 3), np.uint8)
    span = span or depth_range(depth, alpha)
    if span is not None:
        seen = (depth > 0) & (alpha >= ALPHA_MIN)
        low, high = span
        colors[seen] = turbo((depth[seen] - low) / max(high - low, 1e-12))
    return colors


def normal_colors(
    normals: NDArray[np.float32], rotation: NDArray[np.float32], alpha: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Return [H,W,3] = round(255 (n + 1) / 2) in axes x right, y up, z towards the viewer.

    A wall that faces the camera is (128, 128, 255); pixels without a normal, or with alpha below 0.5, are black.
    The rounding moves a normal by less than 0.35 degrees.

    normals     [3,H,W], world frame, unit length or 0
    rotation    [3,3] world -> camera (OpenCV axes)
    alpha       [H,W]
    """
    seen = np.linalg.norm(normals, axis=0) > 0.5
    seen &= alpha >= ALPHA_MIN
    axes = np.diag([1.0, -1.0, -1.0]) @ rotation.astype(np.float64)
    shown = np.einsum("ij,jhw->hwi", axes, normals)
    colors: NDArray[np.uint8] = (255 * (shown + 1) / 2).round().clip(0, 255).astype(np.uint8)
    colors[~seen] = 0
    return colors
