"""Reads explicit Gaussians from interchange formats, by the importers that packages register."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from splatwizard_core.plugins.manager import load_plugins

if TYPE_CHECKING:
    from splatwizard_core.gaussians.model import GaussianModel


def load_ply(path: str | os.PathLike[str]) -> GaussianModel:
    """Read the .ply of a trained 3DGS scene.

    Raises PluginError if nothing installed reads it, BitstreamError if it is damaged, SceneError if it is none.
    """
    found: GaussianModel = load_plugins().importers.load("ply")(path)
    return found
