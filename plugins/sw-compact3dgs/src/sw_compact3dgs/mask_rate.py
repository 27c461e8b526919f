"""Rate model of the volume mask: a Gaussian that its mask keeps has a row in the file, all of equal length."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from sw_gaussians.volume_mask import MaskQuantizer

HALF_BITS = 16
"""Bits of each coordinate and of the opacity."""


@dataclass(frozen=True)
class MaskRate:
    """Rate of Gaussians with mask logits [N].

    quantizer       `ste-mask`, with the threshold of the mask
    size, stages    entries of a codebook, and indices, of both residual quantizers

    Rows are those of the file without post-processing, which codes them in fewer bits. Source: Compact 3D Gaussian
    Representation for Radiance Field (arXiv 2311.13681): the loss of the mask.
    """

    quantizer: MaskQuantizer
    size: int
    stages: int

    @property
    def row_bits(self) -> int:
        """Bits of a row: three coordinates, opacity, indices of scale and rotation."""
        return 4 * HALF_BITS + 2 * self.stages * max((self.size - 1).bit_length(), 1)

    def forecast(self, logits: Tensor) -> Tensor:
        """Return the probability that each row is in the file, [N] in 0..1; differentiable."""
        return torch.sigmoid(logits)

    def rate(self, rows: Tensor) -> Tensor:
        """Bits of the rows: a forecast [N], or 1 and 0; a differentiable scalar."""
        return self.share(rows) * (len(rows) * self.row_bits)

    def share(self, rows: Tensor) -> Tensor:
        """The rate over that of all rows, which is what the published loss has; a differentiable scalar."""
        return rows.mean()

    @torch.no_grad()
    def exact(self, logits: Tensor) -> Tensor:
        """Rows that the file has, bool [N]."""
        return self.quantizer.encode(logits)[0].bool()
