"""Removal of invalid rows (NaN, infinite) from a loaded model, with a count for the user."""

from __future__ import annotations

import logging
from typing import NamedTuple

import torch
from torch import Tensor, nn

from splatwizard_core.errors import SplatwizardError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.gaussians.splat_model import finite_rows

log = logging.getLogger(__name__)

LARGEST_LOGIT = 13.815510
"""Logit of an opacity of 1 - 1e-6: beyond it float32 knows no difference. An infinite one becomes this."""
FLAT = -20.0
"""Log scale of what has no thickness. One of minus infinity becomes this."""
SHORTEST_QUAT = 1e-12
"""Norm below which a quaternion has no direction."""


class LeftOut(NamedTuple):
    """Numbers of the rows that were left out, by why: a value that is no number or infinite; a rotation of zero."""

    not_finite: int = 0
    zero_rotation: int = 0

    def __str__(self) -> str:
        parts = [f"{self.not_finite:,} hold values that are no numbers"] if self.not_finite else []
        parts += [f"{self.zero_rotation:,} have a rotation of zero"] if self.zero_rotation else []
        return f"{sum(self):,} Gaussians mean nothing and were left out: {', '.join(parts)}"


def leave_out_senseless(model: GaussianModel, name: str, *, tell: bool = True) -> GaussianModel:
    """Remove the rows of a model that mean nothing, and make opacities and scales finite that have a limit; in place.

    What was left out stands in `model.origin["left_out"]`.

    name    of the file, for messages
    tell    log what was left out

    Raises SplatwizardError if that is every row.
    """
    finite = torch.ones(model.num_rows, dtype=torch.bool, device=model.device)
    for values in (model.means, model.sh_dc, model.sh_rest, model.quats):
        finite &= finite_rows(values)
    finite &= ~model.opacity_logits.detach().isnan()
    scales = model.log_scales.detach()
    finite &= ~(scales.isnan() | (scales == torch.inf)).any(dim=1)
    turned = model.quats.detach().abs().amax(dim=1) > SHORTEST_QUAT
    sound = finite & turned
    left = LeftOut(int((~finite).sum()), int((finite & ~turned).sum()))
    if any(left):
        if sum(left) == model.num_rows:
            raise SplatwizardError(f"{name}: all of its {left}".replace(" and were left out", ""))
        keep_rows(model, sound)
        model.origin = {**model.origin, "left_out": left._asdict()}
        if tell:
            log.warning("%s: %s", name, left)
    with torch.no_grad():
        for values, least, most in ((model.opacity_logits, -LARGEST_LOGIT, LARGEST_LOGIT), (model.log_scales, FLAT, 0)):
            if bool(values.isinf().any()):
                values.nan_to_num_(nan=torch.nan, posinf=most, neginf=least)
    return model


def keep_rows(model: GaussianModel, kept: Tensor) -> None:
    """Keep the primitives of a mask [N] in every parameter and buffer of `ROWS`."""
    for name in model.ROWS:
        values = getattr(model, name)
        rows = values.detach()[kept]
        if isinstance(values, nn.Parameter):
            setattr(model, name, nn.Parameter(rows, requires_grad=values.requires_grad))
        else:
            model.register_buffer(name, rows)
