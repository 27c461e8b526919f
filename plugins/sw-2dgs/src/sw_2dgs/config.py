"""Hyper-parameters of 2DGS, by default those of the authors' code; what it chooses by data set is unset here."""

from pydantic import Field
from sw_gaussians.choices import CodecChoice
from sw_gaussians.config import GaussianTraining
from sw_gaussians.density.choice import DensityChoice
from sw_gaussians.sized import Capped
from sw_gaussians.start import Rotation
from sw_gaussians.surface_losses import NormalTerm

from splatwizard_core.api import InputFile, Params


class SurfaceTraining(Params):
    """The losses of the surface; what is unset depends on the data set (`sw_2dgs.datasets`)."""

    depth_ratio: float | None = Field(
        None,
        ge=0,
        le=1,
        description="depth of the surface: 0 expected, 1 median; unset: by data set (bounded: 1)",
    )
    lambda_dist: float | None = Field(
        None, ge=0, description="weight of the distortion, for the authors' scene scale; unset: by data set"
    )
    lambda_normal: float | None = Field(
        None, ge=0, description="weight of the normal consistency; unset: by data set (0.05, NeRF Synthetic 0)"
    )
    normal_term: NormalTerm = Field(
        "code", description="form of the normal loss: of the authors' code, or paper: an empty pixel costs nothing"
    )
    dist_after: int = Field(3_000, ge=0, description="last step without the distortion loss")
    normal_after: int = Field(7_000, ge=0, description="last step without the normal loss")


class TwoDGSConfig(Capped, GaussianTraining):
    """Everything that can be set for 2DGS."""

    sh_degree: int = Field(3, ge=0, le=3, description="highest degree of the spherical harmonics")
    init: InputFile = Field(
        "", description="a .ply of surfels to start from, with all its SH bands active; empty: the scene's points"
    )
    init_rotation: Rotation = Field(
        "uniform4", description="first rotations: four numbers in 0..1 as published, haar (uniform) or identity"
    )
    density: DensityChoice = Field(
        # Paper: pruned every 3,000 steps; the authors' code: at each densification. We follow the code.
        DensityChoice(settings={"start": 600, "min_opacity": 0.05}),
        description="density control",
    )
    surface: SurfaceTraining = Field(SurfaceTraining(), description="losses of the surface")
    codec: CodecChoice = Field(CodecChoice(name="gaussians-exact"), description="what writes the file")
