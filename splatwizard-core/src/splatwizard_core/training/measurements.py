"""Measured numbers of a training (counts, times), as stored in checkpoints and the result record."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AliasChoices, Field

from splatwizard_core.base.block import Block, MemoryKind, WhyNull


class Provided(Block):
    """A plugin part used in a run: registered entry, by kind and name, training `stage`, or `task`."""

    kind: str
    name: str
    distribution: str = Field("", description="pip distribution; empty: of none that is installed")
    version: str = ""


class StagePlan(Block):
    """The executed plan of a training stage."""

    stage: str = ""
    iterations: int = 0
    tasks: list[dict[str, Any]] = Field([], description="as `sw schedule --json` prints them")
    looked_up: dict[str, Any] = Field({}, description="values that the configuration leaves to the scene, by key")


class LoopFigures(Block):
    """Numbers of the training loop, copied unchanged into the record's block `train`."""

    peak_bytes: Annotated[int | None, WhyNull("not measured")] = Field(
        None,
        validation_alias=AliasChoices("peak_bytes", "peak_memory"),
        description="over the loop; without evaluation and checkpoints since schema 2",
    )
    memory_kind: MemoryKind | None = Field(None, description="what `peak_bytes` counts: cuda, rss")
    pictures_in: str | None = Field(None, description="where the training pictures lay: host, cuda")
    breakdown_s: Annotated[dict[str, dict[str, float]] | None, WhyNull("not profiled (--set profile=stages)")] = Field(
        None,
        validation_alias=AliasChoices("breakdown_s", "breakdown"),
        description="stage -> part of a step -> seconds, if profiled",
    )


class TrainingFigures(LoopFigures, frozen=False):
    """Numbers of a training over all its stages and processes; part of every checkpoint.

    stage_seconds, stage_steps, provided    by name of the stage: its loop without housekeeping, steps done, who served
    rasterizers     features asked for -> who served them
    """

    pictures_in: str = "host"
    stage_seconds: dict[str, float] = {}
    stage_steps: dict[str, Annotated[int, Field(ge=0)]] = {}
    rasterizers: dict[str, str] = {}
    provided: dict[str, list[Provided]] = {}

    @property
    def steps(self) -> int:
        """Total steps of all stages."""
        return sum(self.stage_steps.values())

    @property
    def train_s(self) -> float:
        """Seconds of all stages' loops, without housekeeping."""
        return sum(self.stage_seconds.values())
