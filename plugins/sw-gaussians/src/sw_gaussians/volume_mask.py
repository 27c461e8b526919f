"""Learned binary mask per Gaussian that multiplies scales and opacity; masked Gaussians are pruned.

Source: Compact 3D Gaussian Representation for Radiance Field (arXiv 2311.13681), section on the volume mask.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from splatwizard_core.api import Camera, EmptyModel, GaussianInputs, GaussianModel, Rasterizer, SplatOptimizer, TaskLog


class MaskQuantizer(Protocol):
    """Quantizer `ste-mask`: 1 where the sigmoid exceeds the threshold, else 0, with the sigmoid's gradient."""

    def forward(self, x: Tensor) -> Tensor: ...

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]: ...


class VolumeMaskedGaussians(GaussianModel):
    """Gaussians with a binary mask M each, rendered with scales s M and opacity o M.

    mask_logits [N]; clones and children of a split copy it
    quantizer   `ste-mask` of sw-codecs, with the threshold of the mask
    init        first logit of every Gaussian; sigmoid(1) = 0.731
    """

    ROWS = (*GaussianModel.ROWS, "mask_logits")

    mask_logits: nn.Parameter

    def __init__(
        self, *tensors: Tensor, quantizer: MaskQuantizer, init: float = 1.0, active_sh_degree: int | None = None
    ) -> None:
        super().__init__(*tensors, active_sh_degree=active_sh_degree)
        self.mask_logits = nn.Parameter(torch.full_like(self.opacity_logits.detach(), init))
        self._quantizer = quantizer

    def mask(self) -> Tensor:
        """[N] of 0 and 1, with the gradient of the sigmoid."""
        return self._quantizer.forward(self.mask_logits)

    @torch.no_grad()
    def mask_on(self) -> Tensor:
        """[N] bool: Gaussians that stay."""
        return self._quantizer.encode(self.mask_logits)[0].bool()

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """All Gaussians, masked; `extras["mask"]` is the sigmoid of the logits, [N], for the loss."""
        inputs, mask = super().gaussians(camera, rasterizer), self.mask()
        assert inputs.scales is not None
        return replace(
            inputs,
            opacities=inputs.opacities * mask,
            scales=inputs.scales * mask[:, None],
            extras={"mask": torch.sigmoid(self.mask_logits)},
        )


@torch.no_grad()
def prune_by_mask(model: VolumeMaskedGaussians, rows: SplatOptimizer, *, step: int) -> int:
    """Remove the Gaussians whose mask is 0; return how many. Raises EmptyModel if none would be left.

    All parameters with rows are new tensors afterwards, also where nothing goes: none is updated in this step.
    """
    stays = model.mask_on()
    if not bool(stays.any()):
        raise EmptyModel(step)
    rows.keep_rows(model, stays)
    return int((~stays).sum())


def mask_prune(model: VolumeMaskedGaussians, optimizer: SplatOptimizer, step: int, log: TaskLog) -> None:
    """Schedule task: remove the Gaussians whose mask is 0; curve "masked"."""
    log.scalar("masked", prune_by_mask(model, optimizer, step=step))
