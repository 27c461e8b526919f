"""Hyper-parameters of 3DGS. Defaults are the paper's (the plan of the Splatwizard paper where they differ)."""

from pydantic import Field
from sw_gaussians.config import GaussianTraining

from splatwizard_core.api import InputFile
from sw_codecs.models.settings import Codec


class ThreeDGSConfig(GaussianTraining):
    """Everything that can be set for 3DGS."""

    sh_degree: int = Field(3, ge=0, le=3, description="highest degree of the spherical harmonics")
    init: InputFile = Field(
        "", description="a .ply to start from, with all its SH bands active; empty: the scene's points"
    )
    codec: Codec = Field(Codec(), description="what the file holds")
