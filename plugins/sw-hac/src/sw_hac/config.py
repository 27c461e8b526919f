"""Hyper-parameters of HAC. Defaults are those of the paper's experiments on Mip-NeRF 360."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field
from sw_anchors.grid_params import GridAnchorParams, GridFileSettings
from sw_gaussians.choices import Choosing, Moved, OwnCodec


class Codec(OwnCodec):
    """The file of HAC, which no other codec can write."""

    name: Literal["hac"] = Field("hac", description="the file of HAC")
    settings: GridFileSettings = Field(GridFileSettings(), description="settings of the file")


class HACConfig(Choosing, GridAnchorParams):
    """Everything that can be set for HAC."""

    OLDER: ClassVar[Mapping[str, Moved]] = {
        f"codec.{name}": Moved((f"codec.settings.{name}",)) for name in GridFileSettings.model_fields
    }

    codec: Codec = Field(Codec(), description="what writes the file")
