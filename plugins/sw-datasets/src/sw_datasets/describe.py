"""Facts of a scene as plain values, for `sw info SCENE`."""

from __future__ import annotations

import math
import re
from collections import Counter
from typing import Any

from splatwizard_core.api import Scene
from sw_datasets.plan_view import plan_view


def describe(scene: Scene) -> dict[str, Any]:
    """Collect facts of a scene that can be printed as JSON; no picture is decoded.

    name, path, dataset, protocol (its id), named_protocol ("survey", "inria", "custom"), background, split     text
    views           {"train": n, "test": n}
    resolutions     [{"width", "height", "views"}], most frequent first
    cameras         {"intrinsics": how many differ, "fov_x_deg": [min, max], "fov_y_deg": [min, max]}
    points          {"count", "colours": bool, "min": [3], "max": [3]} or None
    extent          world units, from the training cameras
    origin          where the scene's origin lies in the world of its files; absent at 0
    masks, ground_truth, warnings
    pictures        file name -> text of a picture: the cameras from above
    """
    views = list({id(view): view for view in (*scene.train, *scene.test)}.values())
    cameras = [view.camera for view in views]
    sizes = Counter((c.width, c.height) for c in cameras)
    points, protocol = scene.points, scene.protocol
    return {
        "name": scene.name,
        "path": scene.path,
        "dataset": protocol.dataset,
        "protocol": protocol.id,
        "named_protocol": protocol.name,
        "background": protocol.background,
        "split": protocol.split,
        "views": {"train": len(scene.train), "test": len(scene.test)},
        "resolutions": [{"width": w, "height": h, "views": n} for (w, h), n in sizes.most_common()],
        "cameras": {
            "intrinsics": len({(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in cameras}),
            "fov_x_deg": _degrees([c.fov_x for c in cameras]),
            "fov_y_deg": _degrees([c.fov_y for c in cameras]),
        },
        "points": None
        if points is None
        else {
            "count": len(points),
            "colours": points.rgb is not None,
            "min": points.xyz.amin(0).tolist() if len(points) else None,
            "max": points.xyz.amax(0).tolist() if len(points) else None,
        },
        "extent": scene.extent,
        **({"origin": list(scene.origin)} if any(scene.origin) else {}),
        "masks": sum(view.load_mask is not None for view in views),
        "ground_truth": sorted(scene.ground_truth),
        "warnings": list(scene.warnings),
        "pictures": {re.sub(r"[^\w.-]+", "-", f"{scene.name}-{protocol.split}") + ".svg": plan_view(scene)},
    }


def _degrees(angles: list[float]) -> list[float]:
    """The smallest and the largest."""
    return [round(angle * 180 / math.pi, 3) for angle in (min(angles), max(angles))]
