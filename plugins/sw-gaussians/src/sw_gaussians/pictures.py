"""Configuration keys of the training-image resolution schedule, which is registered as a task."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from pydantic import Field

from splatwizard_core.api import ConfigError, Params, PluginError

if TYPE_CHECKING:
    from splatwizard_core.api import CameraSampler, OptimizationParams, PluginManager, Scene, Stage

PictureSizes = Callable[..., Any]
"""Makes a schedule from full_at, rounds, most and rounding; see `sw_gaussians.resolution.SmallPictures`."""


class Rounds(NamedTuple):
    """When statistics of density control start anew: sizes of pictures change behind these steps alone.

    growth  steps of this run, ascending
    stop    step of the full run from which no statistics are collected ...
    every   ... and sizes that still change do so after so many steps of the full run
    """

    growth: Sequence[int]
    stop: int
    every: int


class Pictures(Params):
    """A resolution schedule, off by default."""

    schedule: str = Field(
        "none", description="dash: begin with small pictures, whole ones from pictures.until on (DashGaussian)"
    )
    rounding: Literal["real", "floor"] = Field("real", description="scales: real: any; floor: whole ones, as published")
    start: float = Field(4.0, ge=1, description="times that the first pictures are smaller, at most")
    until: int = Field(0, ge=0, description="step from which pictures are whole; 0: that at which growth is over")

    def load(self, plugins: PluginManager) -> PictureSizes | None:
        """Return what makes the schedule, for the stage; None: pictures are whole. Raises ConfigError."""
        if self.schedule == "none":
            return None
        known = [entry.name for entry in plugins.tasks if entry.declared.get("resizes_pictures")]
        if self.schedule not in known:
            raise ConfigError(
                f"no schedule of picture sizes is called '{self.schedule}'; there are: none, {', '.join(known)}",
                key="pictures.schedule",
            )
        found: PictureSizes = plugins.tasks.load(self.schedule)
        return found

    def check(self, opt: OptimizationParams, sizes: PictureSizes | None) -> None:
        """Raise ConfigError for a value without effect in a run of `opt`, PluginError for a stage without its schedule.

        sizes   what `load` returned, as the stage got it
        """
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
        if self.schedule != "none" and sizes is None:
            raise PluginError(
                f"pictures.schedule={self.schedule} does not reach the training: the author of its method has to make "
                "the stage with pictures=config.pictures.load(plugins)"
            )

    def sampler(
        self, sizes: PictureSizes | None, inner: CameraSampler, scene: Scene, stage: Stage, rounds: Rounds
    ) -> CameraSampler:
        """Return a sampler that hands out what `inner` draws in the sizes of the schedule; `inner` where it is off."""
        if sizes is None:
            return inner
        full_at = stage.when(self.until or rounds.stop)
        later = stage.when(range(rounds.stop, self.until, rounds.every))
        assert isinstance(full_at, int)
        assert isinstance(later, range)
        steps = [*rounds.growth, *later]
        full_at = next((step for step in steps if step >= full_at), full_at)
        found = sizes(full_at=full_at, rounds=steps, most=self.start, rounding=self.rounding)
        return found.sampler(inner, scene)  # type: ignore[no-any-return]
