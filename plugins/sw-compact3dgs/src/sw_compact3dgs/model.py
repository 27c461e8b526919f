"""The model while it trains: masked Gaussians, whose colours a field has and whose shapes are quantised at the end."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from sw_gaussians.volume_mask import MaskQuantizer, VolumeMaskedGaussians
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from splatwizard_core.api import SH, GaussianInputs, stream
from sw_codecs.quantizers.residual_quantizer import ResidualVectorQuantizer
from sw_codecs.quantizers.straight_through import straight_through
from sw_compact3dgs.mask_rate import MaskRate
from sw_compact3dgs.seen_rows import SeenRows

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, Rasterizer
    from sw_compact3dgs.colors import ColorField

SMALLEST_SCALE = 1e-8
"""World units; a sum of entries can be zero or less."""

PLAIN, QUANTIZED = "plain", "quantized"


def drawn(
    inputs: GaussianInputs, color: ColorField, features: Tensor | None, camera: Camera, rasterizer: Rasterizer
) -> GaussianInputs:
    """The same Gaussians with the colours that `camera` sees in place of any; the field is asked about visible ones.

    features    [N,F] of all Gaussians if they are known
    """
    rows = SeenRows(rasterizer.visible_filter(inputs, camera) > 0)
    means = rows.take(inputs.means)
    found = color.features(means) if features is None else rows.take(features)
    dc = rows.put(color.coefficients(found, means, camera.center.to(means)))
    return replace(inputs, colors=None, sh=SH(dc=dc[:, None], active_degree=0))


class CompactGaussians(VolumeMaskedGaussians):
    """Gaussians of Compact3DGS.

    color       the colour field; SH coefficients of the base class are not used
    scale_vq    codebooks of the scales, [3] world units, before the mask
    quat_vq     codebooks of the quaternions, normalised
    rate        what masks cost: the loss and the file hold the same
    phase       "plain", or "quantized": what is drawn has the shapes that the codebooks give
    """

    def __init__(
        self, *tensors: Tensor, color: ColorField, quantizer: MaskQuantizer, init: float, size: int, stages: int
    ) -> None:
        super().__init__(*tensors, quantizer=quantizer, init=init)
        self.color = color
        self.rate = MaskRate(quantizer, size, stages)
        self.scale_vq = ResidualVectorQuantizer(size, stages, dim=3)
        self.quat_vq = ResidualVectorQuantizer(size, stages, dim=4)
        self.phase = PLAIN

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """All Gaussians with the colours of this camera, those that it does not see in grey.

        extras: "mask", the forecast of `rate` [N]; "codebooks", the loss of the codebooks once they are there.
        """
        mask, extras = self.mask(), {"mask": self.rate.forecast(self.mask_logits)}
        scales, quats = self.scales, self.unit_quats()
        if self.phase == QUANTIZED:
            sums, scale_loss = self.scale_vq.forward_with_loss(scales)
            scales = straight_through(scales, sums.clamp_min(SMALLEST_SCALE))
            quats, quat_loss = self.quat_vq.forward_with_loss(quats)
            extras["codebooks"] = scale_loss + quat_loss
        masked = GaussianInputs(
            means=self.means, opacities=self.opacities * mask, scales=scales * mask[:, None], quats=quats,
            colors=self.means, extras=extras,  # the visibility test looks at no colours
        )  # fmt: skip
        return drawn(masked, self.color, None, camera, rasterizer)

    def rows_in_file(self) -> Tensor:
        """Return the rows [M] int64 that the masks leave in the file."""
        return torch.nonzero(self.rate.exact(self.mask_logits)).squeeze(1)

    def unit_quats(self) -> Tensor:
        """[N,4] of length 1."""
        return F.normalize(self.quats, dim=1, eps=1e-12)

    @torch.no_grad()
    def fit_codebooks(self, iterations: int) -> None:
        """Make all codebooks from the shapes of now, by k-means from drawn rows, and draw with them from here on."""
        draws = stream(self.split_seed, "codebooks")
        for quantizer, values in ((self.scale_vq, self.scales), (self.quat_vq, self.unit_quats())):
            quantizer.fit(values, generator=draws, iterations=iterations, spread=iterations > 1)
        self.phase = QUANTIZED

    def state_dict_extra(self) -> dict[str, Any]:
        return {**super().state_dict_extra(), "phase": self.phase}

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        super().load_state_dict_extra(extra)
        self.phase = str(extra["phase"])
