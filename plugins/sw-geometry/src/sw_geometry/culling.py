"""Culling of a DTU mesh by the object masks of all views, and its way to millimetres.

Source: evaluation of 2DGS (arXiv 2403.17888) and TrimGS (arXiv 2406.07499) on DTU.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np

from sw_geometry.mesh import Floats, Mask

Rule = Literal["all", "any", "none"]

RADIUS = 24
"""Pixels by which a mask is widened, at the 1600 x 1200 of DTU's own pictures. Other codes take 12 at this size."""


def widened(mask: Mask, radius: float) -> Mask:
    """A mask [H,W] with every pixel that has one of the mask within `radius` pixels: dilation by a disk."""
    from scipy.ndimage import distance_transform_edt

    if not mask.any():
        return mask
    return np.asarray(distance_transform_edt(~mask) <= radius)


def in_view(points: Floats, projection: Floats, mask: Mask) -> tuple[Mask, Mask]:
    """Whether each point [n] falls into the picture of a view, and whether it falls on the mask there.

    projection  [4,4] or [3,4]: units of the points -> pixels of the mask, rows 0..2
    mask        [H,W], already widened; sampled at the nearest pixel

    The picture is the open rectangle between the centres of its outermost pixels. What is behind the camera is
    outside; published code mirrors it into the picture.
    """
    height, width = mask.shape
    u, v, w = (points @ projection[:3, :3].T + projection[:3, 3]).T
    ahead = w * np.sign(np.linalg.det(projection[:3, :3])) > 0  # a projection may have the other sign throughout
    scale = np.where(ahead, w, 1.0)
    x, y = np.where(ahead, u / scale, -1.0), np.where(ahead, v / scale, -1.0)
    inside = ahead & (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
    on_mask = np.zeros(len(points), dtype=bool)
    on_mask[inside] = mask[np.rint(y[inside]).astype(np.int64), np.rint(x[inside]).astype(np.int64)]
    return inside, on_mask


def kept_vertices(vertices: Floats, views: Iterable[tuple[Floats, Mask]], rule: Rule = "all") -> Mask:
    """Vertices [n] that culling leaves.

    views   (projection, widened mask) of each view, as `in_view` takes them
    rule    "all": in every view on the mask or outside the picture (2DGS, TrimGS); "any": on the mask of some view;
            "none": every vertex
    """
    if rule == "none":
        return np.ones(len(vertices), dtype=bool)
    kept = np.full(len(vertices), rule == "all")
    for projection, mask in views:
        inside, on_mask = in_view(vertices, projection, mask)
        kept = kept & (on_mask | ~inside) if rule == "all" else kept | on_mask
    return kept
