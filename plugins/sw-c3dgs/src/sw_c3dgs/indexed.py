"""The model that a file gives: Gaussians that share colours and shapes, with final values."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from splatwizard_core.api import SH, GaussianInputs, GaussianModel, SplatModel
from sw_c3dgs.coded import QUANTIZED, CodedGaussians

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, Rasterizer

LOGIT_MARGIN = 1e-6  # opacities nearer to 0 or 1 would have logits without end
SMALLEST_SCALE = 1e-9  # world units: a shape may be flat, a log scale may not


class IndexedGaussians(GaussianModel):
    """Decoded Gaussians, drawn from their codebooks; the tensors of a GaussianModel are gathered where one asks.

    means           [N,3] world units
    opacity_values  [N] in 0..1
    log_factors     [N]; scale = exp(log factor) times a component of the shape
    color_dc        [Kc,1,3] and color_rest [Kc,K-1,3]: SH coefficients
    shape_scales    [Kg,3] >= 0, and shape_quats [Kg,4]
    color_index     [N] int64 buffer; shape_index the same
    steps, zeros    buffers: the lattices of QUANTIZED, on which the values lie
    """

    ROWS = ("means", "opacity_values", "log_factors", "color_index", "shape_index")

    color_index: Tensor
    shape_index: Tensor
    steps: Tensor
    zeros: Tensor

    def __init__(self, coded: CodedGaussians) -> None:
        SplatModel.__init__(self)  # no tensors of a GaussianModel: they are gathered

        def parameter(array: np.ndarray) -> nn.Parameter:
            return nn.Parameter(torch.from_numpy(np.ascontiguousarray(array)))

        self.means = parameter(coded.means.astype(np.float32))
        # A range that was rounded may end a last bit above 1.
        self.opacity_values = parameter(coded.values("opacity").clip(0, 1))
        self.log_factors = parameter(coded.values("factor"))
        self.color_dc, self.color_rest = parameter(coded.values("dc")), parameter(coded.values("rest"))
        self.shape_scales, self.shape_quats = parameter(coded.values("shape")), parameter(coded.values("quat"))
        self.register_buffer("color_index", torch.from_numpy(coded.color_index.copy()))
        self.register_buffer("shape_index", torch.from_numpy(coded.shape_index.copy()))
        self.register_buffer("steps", torch.from_numpy(coded.steps.copy()))
        self.register_buffer("zeros", torch.from_numpy(coded.zeros.copy()))
        self.active_sh_degree = self.max_sh_degree

    @property
    def max_sh_degree(self) -> int:
        return math.isqrt(1 + self.color_rest.shape[1]) - 1

    @property
    def opacities(self) -> Tensor:
        return self.opacity_values

    @property
    def scales(self) -> Tensor:
        return torch.exp(self.log_factors)[:, None] * self.shape_scales[self.shape_index]

    @property
    def sh_dc(self) -> Tensor:  # type: ignore[override]
        """[N,1,3], gathered."""
        return self.color_dc[self.color_index]

    @property
    def sh_rest(self) -> Tensor:  # type: ignore[override]
        """[N,K-1,3], gathered."""
        return self.color_rest[self.color_index]

    @property
    def opacity_logits(self) -> Tensor:  # type: ignore[override]
        """[N], of opacities kept 1e-6 away from 0 and 1."""
        return torch.logit(self.opacity_values, eps=LOGIT_MARGIN)

    @property
    def log_scales(self) -> Tensor:  # type: ignore[override]
        """[N,3], gathered; of scales of 1e-9 at least."""
        return self.scales.clamp_min(SMALLEST_SCALE).log()

    @property
    def quats(self) -> Tensor:  # type: ignore[override]
        """[N,4], gathered."""
        return self.shape_quats[self.shape_index]

    def counts(self) -> dict[str, int]:
        found = {"num_colors": len(self.color_dc), "num_shapes": len(self.shape_scales)}
        return {"num_gaussians": self.num_rows, **found}

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """All Gaussians; colours and shapes stay in their codebooks."""
        return GaussianInputs(
            means=self.means,
            opacities=self.opacity_values,
            scales=self.shape_scales,
            quats=self.shape_quats,
            geom_indices=self.shape_index,
            scale_factors=torch.exp(self.log_factors),
            sh=SH(
                codebook=torch.cat([self.color_dc, self.color_rest], dim=1),
                indices=self.color_index,
                active_degree=self.active_sh_degree,
            ),
        )

    def coded(self) -> CodedGaussians:
        """Form that this was decoded from, symbol by symbol."""
        tensors = (
            self.opacity_values, self.log_factors, self.color_dc, self.color_rest, self.shape_scales, self.shape_quats,
        )  # fmt: skip
        steps, zeros = self.steps.cpu().numpy(), self.zeros.cpu().numpy()
        symbols = {}
        for at, (name, tensor) in enumerate(zip(QUANTIZED, tensors, strict=True)):
            found = np.rint(tensor.detach().cpu().numpy().astype(np.float64) / steps[at]) + zeros[at]
            symbols[name] = found.clip(0, 255).astype(np.uint8)
        means = self.means.detach().cpu().numpy().astype(np.float16)
        return CodedGaussians(
            means, symbols, steps, zeros, self.color_index.cpu().numpy(), self.shape_index.cpu().numpy()
        )

    def state_dict_extra(self) -> dict[str, Any]:
        return {"active_sh_degree": self.active_sh_degree}

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        self.active_sh_degree = int(extra["active_sh_degree"])
