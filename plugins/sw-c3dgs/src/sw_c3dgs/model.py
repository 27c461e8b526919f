"""The model that is trained: Gaussians that share colours and shapes, drawn through the quantizers of the file."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from sw_gaussians.surfels import refuse_surfels
from torch import Tensor, nn

from splatwizard_core.api import SH, GaussianInputs, GaussianModel, SplatModel
from sw_c3dgs.coded import BITS, HALF_MAX, QUANTIZED, CodedGaussians
from sw_c3dgs.shapes import split_scales
from sw_codecs.quantizers.fake_quant import FakeQuantAffine
from sw_codecs.quantizers.straight_through import straight_through

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, Rasterizer

EMA = 0.99  # of the observed ranges: 1 % of each step's


class SharedGaussians(SplatModel):
    """N Gaussians; a colour of Kc and a shape of Kg for each of them. All values are raw.

    means           [N,3] world units
    opacity_logits  [N]; opacity = sigmoid
    log_factors     [N]; scale = exp(log factor) times a component of the shape
    color_index     [N] int64 buffer, row of sh_dc [Kc,1,3] and sh_rest [Kc,K-1,3]
    shape_index     [N] int64 buffer, row of shapes [Kg,3], used at unit length and not below 0, and of quats [Kg,4]
    is_shared       False as long as each Gaussian has a colour and a shape of its own, before the codebooks are made

    Each of QUANTIZED goes through a quantizer of 8 bits, whose range follows the values while the model trains and
    gradients are recorded; positions are rounded to float16. Gradients pass straight through.
    """

    ROWS = ("means", "opacity_logits", "log_factors", "color_index", "shape_index")

    color_index: Tensor
    shape_index: Tensor

    def __init__(
        self,
        *,
        means: Tensor,
        opacity_logits: Tensor,
        log_factors: Tensor,
        color_index: Tensor,
        shape_index: Tensor,
        sh_dc: Tensor,
        sh_rest: Tensor,
        shapes: Tensor,
        quats: Tensor,
    ) -> None:
        super().__init__()
        self.means, self.opacity_logits = nn.Parameter(means), nn.Parameter(opacity_logits)
        self.log_factors = nn.Parameter(log_factors)
        self.sh_dc, self.sh_rest = nn.Parameter(sh_dc), nn.Parameter(sh_rest)
        self.shapes, self.quats = nn.Parameter(shapes), nn.Parameter(quats)
        self.register_buffer("color_index", color_index)
        self.register_buffer("shape_index", shape_index)
        self.quantizers = nn.ModuleDict({name: FakeQuantAffine(BITS, ema=EMA) for name in QUANTIZED})
        self.quantizers.to(means.device)
        self.is_shared = False

    @classmethod
    def of(cls, model: GaussianModel) -> SharedGaussians:
        """Copies of a model's Gaussians, each with its own colour and shape. Raises UserInputError for surfels."""
        refuse_surfels(model, "codec gaussians-indexed (method c3dgs)")
        log_factors, shapes = split_scales(model.log_scales.detach())
        own = torch.arange(model.num_rows, device=model.device)
        # Row after row, whatever the layout of the originals: Adam rounds by layout, and a resumed model keeps these.
        raw = {
            name: getattr(model, name).detach().clone(memory_format=torch.contiguous_format)
            for name in ("means", "opacity_logits", "sh_dc", "sh_rest", "quats")
        }
        return cls(
            log_factors=log_factors.contiguous(), shapes=shapes.contiguous(), color_index=own, shape_index=own.clone(),
            **raw,
        )  # fmt: skip

    @property
    def sh_degree(self) -> int:
        """The highest SH band; all are active."""
        return math.isqrt(1 + self.sh_rest.shape[1]) - 1

    def counts(self) -> dict[str, int]:
        return {"num_gaussians": self.num_rows, "num_colors": len(self.sh_dc), "num_shapes": len(self.shapes)}

    @torch.no_grad()
    def share(self, kept: Tensor, **tables: Tensor) -> None:
        """Keep the Gaussians `kept` [n] and give them codebooks; quantizers forget the ranges of what was before.

        tables      color_index [n], shape_index [n], sh_dc, sh_rest, shapes, quats

        Parameters are new tensors afterwards: an optimizer must not have moments of the old ones.
        """
        for name in ("means", "opacity_logits", "log_factors"):
            setattr(self, name, nn.Parameter(getattr(self, name).detach()[kept]))
        for name in ("sh_dc", "sh_rest", "shapes", "quats"):
            setattr(self, name, nn.Parameter(tables[name].contiguous()))
        self.color_index, self.shape_index = tables["color_index"], tables["shape_index"]
        for quantizer in self._quantizers():
            quantizer.reset()
        self.is_shared = True

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """All Gaussians with the values that the file would hold; colours and shapes stay in their codebooks."""
        watched = self.training and torch.is_grad_enabled()  # an evaluation leaves no trace in the ranges
        for quantizer in self._quantizers():
            quantizer.observing = watched
        drawn = {name: self.quantizers[name](value) for name, value in self._activated().items()}
        means = self.means.detach()
        return GaussianInputs(
            means=straight_through(self.means, means.clamp(-HALF_MAX, HALF_MAX).half().to(means)),
            opacities=drawn["opacity"],
            scales=drawn["shape"],
            quats=drawn["quat"],
            geom_indices=self.shape_index,
            scale_factors=torch.exp(drawn["factor"]),
            sh=SH(
                codebook=torch.cat([drawn["dc"], drawn["rest"]], dim=1),
                indices=self.color_index,
                active_degree=self.sh_degree,
            ),
        )

    @torch.no_grad()
    def coded(self) -> CodedGaussians:
        """Form in which a file holds these Gaussians. Raises ValueError for values that are not finite."""
        symbols, steps, zeros = {}, [], []
        for name, value in self._activated().items():
            quantizer = self.quantizers[name]
            assert isinstance(quantizer, FakeQuantAffine)
            found, side = quantizer.encode(value)
            symbols[name] = found.cpu().numpy().astype(np.uint8)
            steps.append(side["scale"].item())
            zeros.append(side["zero"].item())
        if not bool(torch.isfinite(self.means).all()):
            raise ValueError("positions to quantize must be finite")
        return CodedGaussians(
            self.means.clamp(-HALF_MAX, HALF_MAX).half().cpu().numpy(),
            symbols, np.array(steps, np.float32), np.array(zeros, np.int32),
            self.color_index.cpu().numpy(), self.shape_index.cpu().numpy(),
        )  # fmt: skip

    def _activated(self) -> dict[str, Tensor]:
        """The values in front of the quantizers, in the order of QUANTIZED."""
        normalise = nn.functional.normalize
        return {
            "opacity": torch.sigmoid(self.opacity_logits),
            "factor": self.log_factors,
            "dc": self.sh_dc,
            "rest": self.sh_rest,
            "shape": normalise(torch.relu(self.shapes), dim=1),
            "quat": normalise(self.quats, dim=1),
        }

    def _quantizers(self) -> list[FakeQuantAffine]:
        return [each for each in self.quantizers.values() if isinstance(each, FakeQuantAffine)]

    def state_dict_extra(self) -> dict[str, Any]:
        return {"is_shared": self.is_shared}

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        self.is_shared = bool(extra["is_shared"])
