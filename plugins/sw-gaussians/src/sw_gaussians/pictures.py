"""Sizes of the training pictures over time, as keys of any method whose own plan does not have those of `fast`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from splatwizard_core.api import Params

if TYPE_CHECKING:
    from splatwizard_core.api import CameraSampler, Scene


class Pictures(Params):
    """A resolution schedule, off by default."""

    schedule: Literal["none", "dash"] = Field(
        "none", description="dash: begin with small pictures, whole ones once growth is over (DashGaussian)"
    )
    rounding: Literal["real", "floor"] = Field("real", description="scales: real: any; floor: whole ones, as published")
    start: float = Field(4.0, ge=1, description="times that the first pictures are smaller, at most")

    def sampler(self, inner: CameraSampler, scene: Scene, *, full_at: int, rounds: Sequence[int]) -> CameraSampler:
        """Return a sampler that hands out what `inner` draws in the sizes of the schedule; `inner` where it is off.

        full_at     step from which pictures are whole
        rounds      steps, ascending, after which the schedule is looked at again: those at which statistics start anew
        """
        if self.schedule == "none":
            return inner
        from sw_gaussians.resolution import by_resolution

        return by_resolution(inner, scene, full_at=full_at, rounds=rounds, most=self.start, rounding=self.rounding)
