"""Hyper-parameters of MesonGS. What the authors chose for each scene is left unset here: see `published.py`."""

from typing import ClassVar, Literal

from pydantic import Field
from sw_gaussians.choices import Choosing, OwnCodec, PrunerChoice
from sw_gaussians.sized import Sized

from splatwizard_core.api import Params
from sw_codecs.models.raht_settings import RahtOptions
from sw_mesongs.published import Family, Point

TABLE = "unset: the published one of the scene"


class Authors(Params):
    """The authors' values that stand for what is unset."""

    family: Family = Field("auto", description="data set whose scene of that name is meant; auto: any of them")
    point: Point = Field(
        "c1", description="configuration of the authors: c1, c2 or c3; tk-c1: of the Splatwizard paper"
    )


class Prune(PrunerChoice):
    """The removal before everything else."""

    pruner: str = Field("mesongs", description="whose scores decide: any registered pruner")
    tau: float | None = Field(
        None, ge=0, lt=1, description=f"all Gaussians up to the score at this share go, with ties; {TABLE}"
    )


class Settings(RahtOptions):
    """Settings of the file: training draws what they make of the Gaussians."""

    depth: int | None = Field(None, ge=1, le=21, description=f"levels of the octree; {TABLE}")
    blocks: int | None = Field(None, ge=1, le=4096, description=f"blocks of the quantizers; {TABLE}")
    codebook_size: int | None = Field(None, ge=1, le=1 << 16, description=f"codebook entries at most; {TABLE}")
    recalibrate: bool = Field(
        False, description="take the ranges of the quantizers anew after the last step; as published they only widen"
    )


class Codec(OwnCodec):
    """The file; since training draws what this codec will decode, there is no other one."""

    name: Literal["raht"] = Field("raht", description="what writes the file")
    settings: Settings = Field(Settings(), description="settings of the file")


class Rates(Params):
    """Adam step sizes of the fine-tuning. Positions are frozen."""

    factor: float | None = Field(None, ge=0, description=f"on all of them; {TABLE}")
    sh_dc: float = Field(2.5e-3, ge=0, description="of SH band 0")
    codebook: float = Field(1.25e-4, ge=0, description="of the codebook of SH bands 1 to 3 (band 0 / 20)")
    opacity: float = Field(0.05, ge=0, description="of the opacity logits")
    scales: float = Field(1e-3, ge=0, description="of the log scales, times the scene extent")
    quats: float = Field(1e-3, ge=0, description="of the quaternions (one public implementation: a fifth of it)")
    final: float = Field(
        1.0, gt=0, le=1, description="share of them that is left at step 3000 of the plan, after an exponential decay"
    )

    def of_step(self, share: float, factor: float, extent: float) -> dict[str, float]:
        """Return the rate by parameter at a `share` 0..1 of the plan.

        factor  on all of them
        extent  of the scene, world units
        """
        rates = {
            "sh_dc": self.sh_dc, "codebook": self.codebook, "opacity_logits": self.opacity,
            "log_scales": self.scales * extent, "quats": self.quats,
        }  # fmt: skip
        return {name: rate * factor * self.final**share for name, rate in rates.items()}


class MesonGSConfig(Sized, Choosing):
    """Everything that can be set for MesonGS."""

    FULL_ITERATIONS: ClassVar[int] = 3_000
    ENCODING: ClassVar[tuple[str, ...]] = ("size",)  # training draws through the codec

    iterations: int = Field(
        3_000, ge=0, description="steps of the fine-tuning (authors' script: 8000); 0: the scene is encoded as it is"
    )
    authors: Authors = Field(Authors(), description="where unset values come from")
    prune: Prune = Field(Prune(), description="what is removed first")
    codec: Codec = Field(Codec(), description="what is drawn while training, and written")
    lr: Rates = Field(Rates(), description="step sizes")
    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM in the loss; the rest is that of L1")
