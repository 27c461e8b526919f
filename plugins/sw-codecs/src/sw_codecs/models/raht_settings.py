"""Settings of codec `raht`."""

from typing import Literal

from pydantic import Field

from splatwizard_core.api import Params
from sw_codecs.models.exchangeable import Exchangeable
from sw_codecs.models.voxels import Anchor, MergeRule


class RahtOptions(Params):
    """Options of the transform chain that do not follow from the size of a scene."""

    bits: int = Field(8, ge=2, le=12, description="of each quantised number")
    merge: MergeRule = Field(
        "mean", description="Gaussians that share a voxel: their mean, the mean weighted by importance, or one of them"
    )
    anchor: Anchor = Field("center", description="where in its voxel a Gaussian lies; corner: as in the authors' code")
    rows_per_code: float = Field(1, ge=1, description="no more than one codebook entry for so many Gaussians")
    vq_training: Literal["batch-mean", "kmeans"] = Field(
        "batch-mean", description="how the codebook is made: by the published batches, or by passes over all"
    )
    vq_steps: int = Field(1000, ge=0, description="batches, or passes")
    vq_batch: int = Field(262_144, ge=1, description="Gaussians of each batch, at most all; drawn with replacement")
    vq_decay: float = Field(0.8, ge=0, lt=1, description="how much of an entry each batch keeps")


class RahtSettings(RahtOptions, Exchangeable):
    """Settings of codec `raht`. Defaults: MesonGS (arXiv 2409.09756), where nothing is known of the scene."""

    depth: int = Field(20, ge=1, le=21, description="levels of the octree: 2^depth voxels an axis of the bounding box")
    blocks: int = Field(66, ge=1, le=4096, description="blocks of successive Gaussians, each with ranges of its own")
    codebook_size: int = Field(2048, ge=1, le=1 << 16, description="codebook entries of SH bands 1 and up, at most")
