"""Settings of meshes and of what is measured on them: options of `sw mesh`, and `metrics.mesh.KEY` of evaluations."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class MeshSettings(BaseModel):
    """Every value is decided by the scene where none is given: see `parameters`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    voxel_size: Positive | None = Field(None, description="edge of a voxel, units of the scene")
    sdf_trunc: Positive | None = Field(None, description="reach of the signed distance, units of the scene")
    depth_trunc: Positive | None = Field(None, description="larger depths are left out, units of the scene")
    mesh_res: int | None = Field(
        None, ge=8, le=65_536, description="voxels along depth_trunc where no voxel_size is given, or along the grid"
    )
    clusters: int | None = Field(None, ge=1, description="largest connected pieces that stay")
    min_views: int = Field(1, ge=1, description="views that must have seen a voxel")
    depth: str | None = Field(
        None, description="depth of the surface: expected, median, or ratio=R between the two (1: median)"
    )
    alpha_min: float = Field(0.5, ge=0, le=1, description="pixels that are less opaque show no surface")
    mask: bool = Field(True, description="pixels outside the masks of the scene show no surface")
    views: Literal["train", "all"] = Field("train", description="views whose depth is fused")
    unbounded: bool = Field(False, description="experimental: contracted space, for scenes with a far background")
    backend: Literal["tensor", "legacy"] = Field(
        "tensor", description="Open3D's grid, or its older class, which Open3D 0.20 cannot extract with"
    )
    max_memory: Positive | None = Field(None, description="GB that the grid may take; half of the machine's")
    cull: Literal["all", "any", "none"] | None = Field(None, description="rule of culling by masks, for DTU")
    tau: Positive | None = Field(None, description="distance within which a point counts as right, units of the scene")
    points: bool = Field(False, description="measure the centres of the Gaussians too")
    dtu_gt: str | None = Field(None, description="folder of the official DTU files Points/ and ObsMask/")

    @field_validator("depth")
    @classmethod
    def _known(cls, value: str | None) -> str | None:
        ratio = None if value is None else re.fullmatch(r"ratio=(\d*\.?\d+)", value)
        if value in (None, "expected", "median") or (ratio and float(ratio[1]) <= 1):
            return value
        raise ValueError("must be expected, median, or ratio=R with R in 0..1")
