"""Statistics of one view for growing and pruning, added by one kernel on CUDA in place of twenty operators."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from sw_anchors import cuda_face
from sw_anchors.fast.kernels import fit_kernels


class Model(Protocol):
    """Protocol of the AnchorModel members that statistics are added to."""

    opacity_accum: Tensor
    anchor_denom: Tensor
    offset_grad_accum: Tensor
    offset_denom: Tensor


class Selection(Protocol):
    """Protocol of the AnchorSelection members read here."""

    @property
    def rows(self) -> Tensor:
        """[V] int64, visible anchors."""
        ...

    @property
    def opacities(self) -> Tensor:
        """[V,k] opacities of all their offsets."""
        ...

    @property
    def drawn(self) -> Tensor:
        """[M] int64, drawn Gaussians among the V k offsets."""
        ...


def fits(model: Model, selection: Selection, gradients: Tensor, radii: Tensor) -> bool:
    """Whether there is a kernel for these tensors; loads it."""
    if not model.opacity_accum.is_cuda or radii.dtype != torch.int32:
        return False
    return fit_kernels(model.opacity_accum, model.offset_denom, selection.opacities, gradients)


def add(model: Model, selection: Selection, gradients: Tensor, radii: Tensor) -> None:
    """Add what `growth.accumulate_anchor_statistics` adds, where it `fits`."""
    totals = model.opacity_accum, model.anchor_denom, model.offset_grad_accum, model.offset_denom
    cuda_face.add_statistics(
        rows=selection.rows, opacities=selection.opacities, drawn=selection.drawn, gradients=gradients.contiguous(),
        radii=radii, opacity_accum=totals[0], anchor_denom=totals[1], offset_grad_accum=totals[2],
        offset_denom=totals[3],
    )  # fmt: skip
    for total in totals:
        increment_version(total)
