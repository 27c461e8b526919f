"""Dense Adam whose update of the spherical harmonics may run inside the rasterizer's backward pass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from splatwizard_core.api import SplatOptimizer
from splatwizard_native import AdamUpdate, end_offer, offer_update
from sw_gaussians.control_tasks import Collect

if TYPE_CHECKING:
    from splatwizard_core.api import RenderResult, Scheduler

MIN_FUSED_GAUSSIANS = 200_000
"""Smallest number of Gaussians to fuse: step time is equal at 185,000 and 0.91 times at one million."""
OFFERED = ("sh_dc", "sh_rest")
"""Parameters that may be fused: no activation between storage and kernel; 48 of a Gaussian's 59 numbers."""


class FusingOptimizer(SplatOptimizer):
    """Dense Adam; `offer` before a render avoids writing and reading gradients of spherical harmonics.

    Source: Faster-GS (arXiv 2602.09999), whose fused backward pass and optimizer do so for all parameters.
    """

    _waiting: tuple[tuple[str, Tensor], ...] = ()

    def offer(self) -> None:
        """Let the next backward pass do this step's updates; valid only if one render gives the whole gradient."""
        params = [(name, getattr(self.model, name)) for name in OFFERED]
        fit = [name for name, p in params if p.is_cuda and p.dtype == torch.float32 and p.is_contiguous()]
        self._offer_all([name for name in fit if name in self.states])  # moments exist from the first update on

    def _offer_all(self, names: Sequence[str]) -> None:
        waiting = []
        for name in names:
            param, state = getattr(self.model, name), self.states[name]
            group, moments = self.groups[name], state.tensors
            update = AdamUpdate(
                param.data, param.data, moments["exp_avg"], moments["exp_avg_sq"],
                lr=group.lr, beta1=group.betas[0], beta2=group.betas[1], eps=group.eps, step=state.step + 1,
            )  # fmt: skip
            offer_update(param, update)
            waiting.append((name, param))
        self._waiting = tuple(waiting)

    def step(self, result: RenderResult | None = None) -> None:
        """Update every parameter with a gradient that the backward pass has not updated; count its updates."""
        for name, param in self._waiting:
            if not end_offer(param) and param.grad is None:  # with a gradient it is done, and counted, below
                self.states[name].step += 1
        self._waiting = ()
        super().step(result)


def offer_updates(
    optimizer: SplatOptimizer | None, post: Scheduler | None, step: int, *, before: int, forced: bool
) -> None:
    """Fuse the updates into the backward pass unless a task other than statistics reads gradients.

    post    tasks of the stage
    before  steps from here on make no update
    forced  also below `MIN_FUSED_GAUSSIANS` Gaussians
    """
    if not isinstance(optimizer, FusingOptimizer) or post is None:
        return
    if not forced and optimizer.model.num_rows < MIN_FUSED_GAUSSIANS:
        return
    due = (entry.task for entry in post.registrations if entry.due(step))
    if step < before and torch.is_grad_enabled() and all(isinstance(task, Collect) for task in due):
        optimizer.offer()
