"""Typed configuration of a run (`PipelineParams`) and of a method (`OptimizationParams`)."""

import dataclasses
import difflib
import typing
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, create_model, model_validator

from splatwizard_core.errors import ConfigError
from splatwizard_core.scene.dataset import SceneOptions

ParamsT = TypeVar("ParamsT", bound="Params")


class ReadsFile:
    """Marks a field that names a file: its content, not its path, enters the training identity."""


InputFile = Annotated[str, ReadsFile()]
"""Field type for the path of a file that training reads; empty: none."""


class SameResult:
    """Marks a field that changes how something is computed, not the result; not part of the training identity."""


HowInt = Annotated[int, SameResult()]
HowBool = Annotated[bool, SameResult()]


class Params(BaseModel):
    """Base of every configuration block: unknown keys and values out of bounds are errors; blocks may nest.

    Trainings are told apart by the values that differ from the defaults. So a new key whose default changes nothing
    leaves every finished training as it is, and a changed default has to be counted:

    DEFAULTS    how often a default that this very class states was changed since release 0.3
    """

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False)
    DEFAULTS: ClassVar[int] = 0

    def normal(self: ParamsT, plugins: Any) -> ParamsT:
        """Return this with each value that changes no result at its default, in nested blocks too.

        plugins     the PluginManager, for blocks whose values belong to something that is registered
        """
        changed: dict[str, Any] = {}
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            if any(isinstance(mark, SameResult) for mark in field.metadata):
                changed[name] = field.get_default(call_default_factory=True)
            elif isinstance(value, Params):
                changed[name] = value.normal(plugins)
        return self.model_copy(update=changed)


class RasterParams(Params):
    """Choice among the installed rasterizers, and options that hold in place of those of the method or of a file."""

    prefer: list[str] = Field([], description="rasterizers to take first if they can, by name")
    forbid: list[str] = Field([], description="rasterizers never to take, by name")
    profile: str | None = Field(
        None, description="set of constants and quirks that rasterizers know by this name; none: as method or file asks"
    )
    antialias: bool | None = Field(
        None, description="compensate opacities for the low-pass (Mip-Splatting); none: as method or file asks"
    )
    eps2d: float | None = Field(
        None, ge=0, le=100, description="low-pass of the projected Gaussians, px^2; none: as method or file asks (0.3)"
    )

    @property
    def options(self) -> dict[str, Any]:
        """Values of `RasterOptions` that the user has decided."""
        return self.model_dump(exclude={"prefer", "forbid"}, exclude_none=True)


class LogParams(Params):
    """Programs that a training is logged for besides log.jsonl: observers of `run_started` read it."""

    tensorboard: HowBool = Field(
        False, description="write the curves for TensorBoard too, into tensorboard/ of the run"
    )
    view: HowInt = Field(0, ge=0, le=65535, description="port where a viewer shows the training; 0: nowhere")


class AddedTask(Params):
    """A registered schedule task in the plan of a method: one table of `[[tasks]]`."""

    name: str = Field(min_length=1, description="of the task, as `sw list-plugins` shows it")
    steps: int | list[int] | str = Field(description="a step, a list of steps, or 'range(first, end, every)'")
    settings: dict[str, Any] = Field({}, description="settings of the task, by its own keys")
    stage: str = Field("", description="of the method, as `sw schedule` shows it; none: the first")
    before_render: bool = Field(False, description="a pre task; else it runs between backward and the optimizer step")
    priority: int = Field(0, description="lower runs earlier, equal ones after the method's own")

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, value: Any) -> Any:
        for key in value if isinstance(value, dict) else ():
            if key not in cls.model_fields:
                near = difflib.get_close_matches(key, cls.model_fields, n=1)
                hint = f"did you mean '{near[0]}'?" if near else f"a task has {', '.join(cls.model_fields)}"
                raise ConfigError(f"unknown key '{key}' of [[tasks]]: {hint}", key="tasks")
        return value


class PipelineParams(Params):
    """Parameters of the run that no method owns (`ppl` in the paper's signature)."""

    seed: int = Field(
        0,
        ge=0,
        strict=True,
        description="one integer; init, sampler, split, background and method streams derive from it",
    )
    device: Annotated[Literal["auto", "cpu", "cuda"], SameResult()] = Field(
        "auto", description="auto: CUDA if its kernels can run, else CPU"
    )
    threads: HowInt = Field(0, ge=0, le=1024, description="CPU threads; 0: all cores that this process may use")
    checkpoint_every: HowInt = Field(1000, ge=1, description="steps between checkpoints")
    log_every: HowInt = Field(10, ge=1, description="steps between lines of log.jsonl")
    keep_checkpoints: HowInt = Field(1, ge=1, description="how many of the newest checkpoints stay")
    eval_every: HowInt = Field(0, ge=0, description="steps between evaluations on the test views; 0: only at the end")
    eval_train: HowBool = Field(True, description="draw the training views once at the end and record their PSNR")
    random_background: bool = Field(False, description="a fresh background colour per step in training")
    clamp_render: bool = Field(False, description="clamp the render to [0,1] before the loss (inria 2024)")
    deterministic: bool = Field(False, description="equal runs give equal bits on CUDA too; slower, more memory")
    profile: Annotated[Literal["none", "stages"], SameResult()] = Field(
        "none", description="stages: time each stage of a step"
    )
    tasks: list[AddedTask] = Field([], description="registered schedule tasks that the plan has besides ([[tasks]])")
    raster: RasterParams = Field(RasterParams(), description="which rasterizers may serve")
    log: LogParams = Field(LogParams(), description="where else the training is logged")


_fields: dict[str, Any] = {f.name: f.default for f in dataclasses.fields(SceneOptions) if f.name != "seed"}
_fields = {name: (typing.get_type_hints(SceneOptions)[name], default) for name, default in _fields.items()}
SceneParams = create_model("SceneParams", __base__=Params, **_fields)
"""How the scene is read: `SceneOptions` as a block, without the seed of its start points, which is the run's."""


class OptimizationParams(Params):
    """Hyper-parameters of a method (`opt` in the paper's signature); each method subclasses it.

    FULL_ITERATIONS     the run length that the method's plans are written for
    ENCODING            fields that only `encode` reads: rate points that differ in these alone share their training
    ABSENT              dotted key -> value of trainings of release 0.2 and before that do not tell it, if it is not
                        the default
    """

    FULL_ITERATIONS: ClassVar[int] = 30_000
    ENCODING: ClassVar[tuple[str, ...]] = ("codec",)
    ABSENT: ClassVar[Mapping[str, Any]] = {}

    iterations: int = Field(
        30_000, ge=1, le=10**9, description="steps; plans keep their ranges, tasks past the end never fire"
    )
    scale_schedule: bool = Field(
        False, description="multiply plan bounds, intervals and lr max_steps by iterations / those of a full run"
    )

    @property
    def schedule_scale(self) -> float:
        """Factor on plan bounds, intervals and lr max_steps: iterations / FULL_ITERATIONS with scale_schedule, else 1.

        A stage applies it to what it registers, `plan.scaled(when, opt.schedule_scale)`, and to what it reads
        itself (lr max_steps, "not before step 3000" rules). In a method of several stages `iterations` is the length
        of the longest one; the others are scaled along.
        """
        return self.iterations / self.FULL_ITERATIONS if self.scale_schedule else 1.0

    def spelled(self, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return values by dotted key with today's keys in place of shorthands and of those of older releases."""
        return values

    def settings_keys(self, plugins: Any) -> dict[str, str]:
        """Map dotted keys of settings of what it names in `plugins` to their descriptions."""
        return {}

    def completed(self, plugins: Any, sources: Mapping[str, str]) -> "OptimizationParams":
        """Return this with checked settings of what it names in `plugins`; sources: dotted key -> who gave a value."""
        return self
