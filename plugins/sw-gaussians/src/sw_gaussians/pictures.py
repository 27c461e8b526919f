"""Configuration keys of the training-image resolution schedule."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from splatwizard_core.api import ConfigError, Params

if TYPE_CHECKING:
    from splatwizard_core.api import CameraSampler, OptimizationParams, Scene, Stage


class Pictures(Params):
    """A resolution schedule, off by default."""

    schedule: Literal["none", "dash"] = Field(
        "none", description="dash: begin with small pictures, whole ones from pictures.until on (DashGaussian)"
    )
    rounding: Literal["real", "floor"] = Field("real", description="scales: real: any; floor: whole ones, as published")
    start: float = Field(4.0, ge=1, description="times that the first pictures are smaller, at most")
    until: int = Field(0, ge=0, description="step from which pictures are whole; 0: that at which growth is over")

    def check(self, opt: OptimizationParams) -> None:
        """Raise ConfigError for a value without effect in a run of `opt`; for when a stage is made."""
        if self.until and self.schedule == "none":
            raise ConfigError(
                "pictures.until says when pictures become whole: set pictures.schedule=dash with it",
                key="pictures.until",
            )
        steps = opt.FULL_ITERATIONS if opt.scale_schedule else opt.iterations
        if self.until > steps:
            raise ConfigError(
                f"pictures.until is {self.until}, and the plan ends at {steps}: pictures never become whole, lower it",
                key="pictures.until",
            )

    def sampler(
        self, inner: CameraSampler, scene: Scene, stage: Stage, *, growth: Sequence[int], growth_stop: int, every: int
    ) -> CameraSampler:
        """Return a sampler that hands out what `inner` draws in the sizes of the schedule; `inner` where it is off.

        stage           scales plans to the length of this run
        growth          steps of this run at which statistics start anew, ascending: sizes change behind them alone
        growth_stop     step of the full run from which no statistics are collected ...
        every           ... and sizes that still change do so after so many steps of the full run
        """
        if self.schedule == "none":
            return inner
        from sw_gaussians.resolution import by_resolution

        stop = self.until or growth_stop
        full_at, later = stage.when(stop), stage.when(range(growth_stop, stop, every))
        assert isinstance(full_at, int)
        assert isinstance(later, range)
        rounds = [*growth, *later]
        return by_resolution(
            inner,
            scene,
            full_at=next((step for step in rounds if step >= full_at), full_at),
            rounds=rounds,
            most=self.start,
            rounding=self.rounding,
        )
