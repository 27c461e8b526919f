"""Undoing the map that nerfstudio lays over a scene before it trains: x_model = s (R x + t).

Source: the public sources of nerfstudio-project/nerfstudio.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from splatwizard_core.api import BitstreamError, SceneError, UserInputError
from sw_interchange.frames import transformed
from sw_interchange.scene import GaussianScene
from sw_interchange.source import json_reason

MAX_BYTES = 1 << 20


def undone(scene: GaussianScene, path: str | os.PathLike[str]) -> GaussianScene:
    """The scene in the axes and the size of the photographs' cameras.

    path    dataparser_transforms.json: {"transform": [R|t] 3x4, "scale": s}

    Raises SceneError if it cannot be read, BitstreamError if it says no such map.
    """
    name = Path(path).name
    try:
        with open(path, "rb") as file:
            told = json.loads(file.read(MAX_BYTES))
        matrix = np.array(told["transform"], np.float64)
        scale = float(told["scale"])
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}", path=str(path)) from error
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise BitstreamError(f"{name}: no map of nerfstudio: {type(error).__name__}: {json_reason(error)}") from error
    if matrix.shape != (3, 4) or not np.isfinite(matrix).all() or not 1e-12 < scale < 1e12:
        raise BitstreamError(f"{name}: no map of nerfstudio: a 3x4 transform and a scale above 0")
    rotation, offset = matrix[:, :3], matrix[:, 3]
    try:
        return transformed(scene, rotation.T, 1 / scale, -rotation.T @ offset)
    except UserInputError as error:
        raise BitstreamError(f"{name}: {error}") from error
