"""The student: Gaussians whose SH degree 3 a learned binary mask switches off, one by one."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import torch
from sw_gaussians.finetune.importance import ScoredGaussians
from sw_gaussians.surfels import refuse_surfels
from torch import Tensor, nn

from splatwizard_core.api import SH, GaussianInputs, GaussianModel

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, Rasterizer

LOWER = 8
"""Coefficients of SH degrees 1 and 2 in `sh_rest`; the 7 behind them are degree 3."""
DEGREE = 3


class MaskQuantizer(Protocol):
    """The quantizer `ste-mask`: 0 or 1 ahead, the sigmoid's gradient back."""

    def forward(self, x: Tensor) -> Tensor: ...

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]: ...


class MaskedGaussians(ScoredGaussians):
    """Gaussians of degree 3 with a mask that ChimeraGS learns.

    mask_logits [N]; the mask is on where the sigmoid is above the threshold, and its gradient is the sigmoid's
    importance  [N] buffer, of any sign; the file keeps best what is high here
    """

    ROWS = (*GaussianModel.ROWS, "mask_logits", "importance")

    mask_logits: nn.Parameter

    def __init__(self, *tensors: Tensor, quantizer: MaskQuantizer, init: float) -> None:
        super().__init__(*tensors, active_sh_degree=DEGREE)
        self.mask_logits = nn.Parameter(torch.full_like(self.opacity_logits, init))
        self._quantizer = quantizer
        self._scored = ""  # digest of the means that `importance` belongs to

    @classmethod
    def of(cls, model: GaussianModel, *, quantizer: MaskQuantizer, init: float) -> MaskedGaussians:
        """Copies of a model's Gaussians; SH bands that it lacks are zero. Raises UserInputError for surfels."""
        refuse_surfels(model, "method chimerags")
        tensors = [getattr(model, name).detach().clone() for name in cls.RAW]
        rest = model.sh_rest.new_zeros(model.num_rows, (DEGREE + 1) ** 2 - 1, 3)
        rest[:, : model.sh_rest.shape[1]] = model.sh_rest.detach()
        tensors[cls.RAW.index("sh_rest")] = rest
        return cls(*tensors, quantizer=quantizer, init=init)

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """All Gaussians; `extras["mask"]` is the sigmoid of the logits, [N]."""
        mask = self._quantizer.forward(self.mask_logits)[:, None, None]
        rest = torch.cat([self.sh_rest[:, :LOWER], self.sh_rest[:, LOWER:] * mask], dim=1)
        sh = SH(dc=self.sh_dc, rest=rest, active_degree=DEGREE)
        drawn = super().gaussians(camera, rasterizer)
        return replace(drawn, sh=sh, extras={"mask": torch.sigmoid(self.mask_logits)})

    @torch.no_grad()
    def mask_on(self) -> Tensor:
        """[N] bool: which Gaussians keep degree 3."""
        return self._quantizer.encode(self.mask_logits)[0].bool()

    @torch.no_grad()
    def set_importance(self, scores: Tensor) -> None:
        """Keep the scores [N], also negative ones, of the Gaussians at the places where they are now."""
        # A score of -inf (never seen) would not survive arithmetic on it.
        self.importance.copy_(scores.clamp_min(torch.finfo(self.importance.dtype).min))
        self._scored = self._digest()

    def after_cut(self) -> None:
        """Let the importance of the rows that are left stay what it is."""
        self.set_importance(self.importance)

    def has_importance(self) -> bool:
        """Whether the importance is that of these very Gaussians: as many, at the same places."""
        return self._scored == self._digest()

    def _digest(self) -> str:
        return hashlib.sha256(self.means.detach().cpu().contiguous().numpy().tobytes()).hexdigest()

    def state_dict_extra(self) -> dict[str, Any]:
        return {**super().state_dict_extra(), "scored": self._scored}

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        super().load_state_dict_extra(extra)
        self._scored = str(extra["scored"])
