"""Depth as OpenEXR, where a library that writes it is installed."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import UserInputError, replacing


def exr_library() -> ModuleType:
    """Return the library. Raises UserInputError that names the extra which brings it."""
    try:
        import OpenEXR
    except ImportError as error:
        raise UserInputError(
            "--depth-exr needs the package OpenEXR: pip install 'sw-view[exr]' (.npz holds the same values)"
        ) from error
    library: ModuleType = OpenEXR
    return library


def write_exr(path: Path, depth: NDArray[np.float32]) -> None:
    """Write [H,W] float32 as the one channel Z, compressed without loss, atomically."""
    library = exr_library()
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    with replacing(path) as temporary, library.File(header, {"Z": np.ascontiguousarray(depth)}) as file:
        file.write(str(temporary))
