"""Between the neutral scene and the models that Splatwizard draws and trains."""

from __future__ import annotations

import numpy as np
import torch
from sw_gaussians.render_options import antialias_of
from sw_gaussians.surfels import gaussians_of

from splatwizard_core.api import GaussianModel
from sw_interchange.bands import Array
from sw_interchange.scene import FLAT, GaussianScene, normalised


def to_gaussians(scene: GaussianScene) -> GaussianModel:
    """A model on the CPU, all its SH bands active: surfels (SurfelModel) of a scene of these. Degree 4 becomes 3.

    Its `origin` asks for antialiasing if the scene was trained with it.
    """
    scene = scene.in_frame("RDF").with_degree(min(scene.sh_degree, 3))
    scales = scene.log_scales[:, :2] if scene.kind == "2dgs" else scene.log_scales
    columns = (scene.means, scene.sh_dc[:, None], scene.sh_rest, scene.opacity_logits, scales, scene.quats)
    model = gaussians_of(*(torch.from_numpy(_owned(column)) for column in columns))
    model.origin = {"raster": {"antialias": True} if scene.antialiased else {}}
    return model


def from_gaussians(model: GaussianModel) -> GaussianScene:
    """The scene of a model: its active SH bands, quaternions normalised. A copy where the model is not on the CPU.

    antialiased: as the model's `origin` says.
    """
    # Trained rows may lie column after column, and writers look at the bytes of a row.
    columns = {name: getattr(model, name).detach().cpu().float().contiguous().numpy() for name in model.RAW}
    scales, flat = columns["log_scales"], columns["log_scales"].shape[1] == 2
    if flat:
        scales = np.concatenate([scales, np.full((len(scales), 1), FLAT, np.float32)], axis=1)
    scene = GaussianScene(
        columns["means"],
        scales,
        normalised(columns["quats"])[0],
        columns["opacity_logits"],
        columns["sh_dc"][:, 0],
        columns["sh_rest"],
        antialiased=antialias_of(model),
        kind="2dgs" if flat else "default",
    )
    return scene.with_degree(min(model.active_sh_degree, scene.sh_degree))


def _owned(column: Array) -> Array:
    """The column in one piece of memory that may be written to, as torch wants it."""
    return np.require(column, np.float32, ["C", "W"])
