"""Typed outcomes of the steps of a run, as steps.json remembers them and `--json` prints them."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from splatwizard_core.base.block import Block, MemoryKind
from splatwizard_core.evaluation.speed import SpeedBlock
from splatwizard_core.runs.record import DecodeFigures, MemoryBlock, PhaseBlock, PretrainingBlock, Quality, TrainBlock
from splatwizard_core.training.measurements import Provided, StagePlan
from splatwizard_native import CoreTime

CONTENDED = "contended"
"""The flag of a record whose times other processes lengthened."""


def contention(phase: str, cores: CoreTime) -> dict[str, float]:
    """Return the phase, timed since `cores` was made, with the share of the cores that it had; empty if it had all."""
    share = cores.shortage()
    return {} if share is None else {phase: share}


class StepFacts(Block):
    """Base of the outcomes: which timed phases had to share the cores, with the share that they had."""

    contended: dict[str, float] = {}


class TrainingFacts(StepFacts, TrainBlock):
    """Outcome of a training; `checkpoints` is not empty where they lie with another rate point, `trained_in`.

    raster      what the header of its file asks of a rasterizer
    file        name and sha256 of the .ply that it came from in place of a training
    """

    plan: list[StagePlan] = []
    rasterizers: dict[str, str] = {}
    phases: list[PhaseBlock] = []
    raster: dict[str, Any] = {}
    made_by: dict[str, str] = {}
    file: dict[str, str] = {}
    checkpoints: str = ""

    @property
    def total_s(self) -> float | None:
        """Seconds of the training with those of what it started from; None if that came from a file."""
        seconds = [self.train_s, *(each.train_s for each in self.pretraining.values())]
        return None if None in seconds else sum(each for each in seconds if each is not None)

    def as_start(self, preset: str, config: dict[str, Any]) -> PretrainingBlock:
        """Return what is told of it by a training that started from it; what nobody knows of a file is None."""
        if self.file:
            return PretrainingBlock(file=self.file)
        return PretrainingBlock(
            preset=preset, config=config, steps=self.steps, train_s=self.total_s, made_by=self.made_by
        )


class EncodingFacts(StepFacts):
    """Outcome of an encoding; `float32_bytes` are those of the model's parameters as they were trained."""

    encode_s: float
    float32_bytes: int = 0
    bytes: int
    sha256: str
    made_by: dict[str, str] = {}
    parts: list[Provided] = []


class DecodingFacts(StepFacts, DecodeFigures):
    """Outcome of the timed decodes of a file; `peak_bytes` is the growth over the first."""

    method: str
    method_version: int
    digest: str
    counts: dict[str, int]
    bytes: int
    packets: int = 0
    sections: dict[str, int]
    raster: dict[str, Any] = {}
    decode_s: float
    peak_bytes: int
    memory_kind: MemoryKind
    device: str = ""


class Extent(Block):
    """Extent of a measurement; `metrics` tells what the values of each depend on, None: it cannot be computed now."""

    repeats: int
    metrics: dict[str, Any]
    eval_train: bool = False

    def holds(self, asked: Extent) -> bool:
        """Whether a measurement of this extent has all that is asked for; one that has more is kept."""
        wanted = {name: now for name, now in asked.metrics.items() if now is not None}
        enough = self.repeats >= asked.repeats and self.eval_train >= asked.eval_train
        return enough and all(self.metrics.get(name) == now for name, now in wanted.items())


class Measurement(StepFacts, Quality):
    """Outcome of measuring a model on a scene; `asked` where a run remembers it, `renders` where they were kept."""

    digest: str
    drawn_gaussians: float | None = None
    renders: list[str] = []
    speed: SpeedBlock | None = None
    memory: MemoryBlock | None = None
    rasterizers: dict[str, str] = Field({}, description="features asked for -> who served them")
    raster: dict[str, Any] = Field({}, description="options of drawing that are not the defaults")
    asked: Extent | None = None


class Recorded(Block):
    """Outcome of writing the record: of which file, and what was measured of it."""

    sha256: str
    asked: Extent
