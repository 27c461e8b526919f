"""The model of HAC++: anchors on the lattice of voxels, whose features are predicted by the grid and by one another.

Source: HAC++ (arXiv 2501.12255), and published facts about the authors' code.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from sw_anchors.lattice import position_codes
from torch import Tensor, nn

from splatwizard_native import fast_enabled
from sw_hac.model import HACAnchors
from sw_hac_plus.channel_mixture import ChannelMixture
from sw_hac_plus.fast import masked as fast_masked
from sw_hac_plus.rate_model import HACPlusRateModel
from sw_hac_plus.voxel_lattice import voxel_integers, voxel_positions, within_reach

if TYPE_CHECKING:
    from sw_anchors.neural_gaussians import NeuralGaussians

    from splatwizard_core.api import GaussianInputs


class HACPlusAnchors(HACAnchors):
    """HACAnchors on the lattice of voxels, with a channel context; the rate may switch off any anchor, seen or not.

    channel             second Gaussian of each feature; None: the grid alone predicts, as in HAC
    anchor_gradient     whether the gradient of all bits of an anchor reaches its masks

    The network behind the grid has F further outputs: logits of the weight of its Gaussian.
    """

    RATE_OF: ClassVar[Literal["visible", "all"]] = "all"

    def __init__(
        self, *tensors: Tensor, channel: ChannelMixture | None, anchor_gradient: bool = True, **kwargs: Any
    ) -> None:
        """Take what HACAnchors takes, and the channel context."""
        super().__init__(*tensors, further=0 if channel is None else tensors[1].shape[1], **kwargs)
        self.channel = None if channel is None else channel.to(self.features)
        self.anchor_gradient = anchor_gradient
        self.STEP_POWERS = (1.0 if channel is None else 0.0, 1.0, 1.0)

    @property
    def rate_model(self) -> HACPlusRateModel:
        return HACPlusRateModel(**vars(super().rate_model), channel=self.channel, anchor_gradient=self.anchor_gradient)

    def networks(self) -> dict[str, nn.Module]:
        return super().networks() | ({} if self.channel is None else {"channel": self.channel})

    def lattice_places(self) -> tuple[Tensor, Tensor]:
        positions = voxel_positions(voxel_integers(self.anchors, self.voxel_size), self.voxel_size)
        return position_codes(positions, self.bounds), positions

    def holds(self, positions: Tensor) -> Tensor:
        """Return [M] bool: `positions` [M,3] that the file can hold beside the anchors."""
        return within_reach(positions, self.anchors, self.voxel_size)

    def drawn(
        self, rows: Tensor, found: NeuralGaussians, masks: Tensor | None, extras: dict[str, Any]
    ) -> GaussianInputs:
        """Multiply scales by the masks too, and let statistics see the opacity that a masked Gaussian would have."""
        if masks is not None and masks.requires_grad:
            multiplied = fast_masked.masked if fast_enabled() else masked
            found = dataclasses.replace(found, scales=multiplied(found.scales, masks, found.drawn))
        return super().drawn(rows, dataclasses.replace(found, all_opacities=found.alphas), masks, extras)


def masked(values: Tensor, masks: Tensor, drawn: Tensor) -> Tensor:
    """Multiply values [M,C] by the masks [V,k] at `drawn` [M]: 1, as nothing else is drawn, but with a gradient."""
    return values * masks.reshape(-1).index_select(0, drawn)[:, None]
