"""Base class of training stages: schedule, loss, optimizer, rendering options."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.rendering.rasterizer import Rasterizer, RasterOptions, RenderResult
from splatwizard_core.scene.scene import Scene, View
from splatwizard_core.training.losses import LossPack, photometric_loss
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.plan import When, scaled

if TYPE_CHECKING:
    from splatwizard_core.training.optimizer import SplatOptimizer
    from splatwizard_core.training.scheduler import Scheduler
    from splatwizard_core.training.state import TrainingState


class CameraSampler:
    """Samples training views; its state can be saved and restored.

    Default: uniformly without replacement over the training views, refilled when empty.
    A stage with its own idea (pseudo views, say) subclasses it; a view without a picture is legal if the
    stage's loss does not ask for one.
    """

    def __init__(self, views: list[View], generator: torch.Generator) -> None:
        if not views:
            raise ValueError("a camera sampler needs at least one view")
        self.views = views
        self.generator = generator
        self._order: list[int] = []

    def next(self, step: int) -> View:
        """Return the view of this step."""
        if not self._order:
            self._order = torch.randperm(len(self.views), generator=self.generator).tolist()
        return self.views[self._order.pop()]

    def state_dict(self) -> dict[str, Any]:
        """Return the order that is left (JSON-able) and the generator's state, a tensor under "generator"."""
        return {"order": list(self._order), "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned. Raises ValueError if it is that of a sampler of other views."""
        order = [int(i) for i in state["order"]]
        if order and max(order) >= len(self.views):
            raise ValueError(f"the state is that of a sampler of other views: view {max(order)} of {len(self.views)}")
        self._order = order
        self.generator.set_state(state["generator"])


class CameraIterator(list[View]):
    """Training views in order, for schedule tasks to iterate over; independent of the training sampler."""


@dataclass
class StageContext:
    """Inputs of a stage from the run: scene, rasterizer, config and more.

    model       the model as the stage before left it (or as `Method.create_model` made it)
    scene       the scene
    ppl         run parameters
    rasterizer  what the trainer renders with; a stage whose loss renders too (a teacher) keeps it
    generator   (stream name) -> an independent seeded torch.Generator: "init", "split", "method", ...
    trained     (method name) -> a frozen, trained model of this scene: from the cache, trained first, or from the
                .ply of --init; for stages that start from, or are taught by, a trained 3DGS scene
    """

    model: SplatModel
    scene: Scene
    ppl: PipelineParams
    rasterizer: Rasterizer
    generator: Callable[[str], torch.Generator]
    trained: Callable[[str], SplatModel]


class PlannedTask(NamedTuple):
    """A task that a configuration puts into a plan."""

    before_render: bool
    when: When
    task: Callable[..., Any]
    priority: int = 0
    name: str = ""


class Stage:
    """One training stage of a method: subclass it and override what differs.

    name        shown in plans and logs
    opt         the hyper-parameters that its tasks see as OptimizationParams; a borrowed stage brings its own
    extra_tasks tasks that the configuration puts into the plan besides the stage's own
    views_per_step  views that a step draws, all processes together; `opt` counts its plan and its steps in views
    """

    name: str = "train"
    extra_tasks: tuple[PlannedTask, ...]

    def __init__(self, opt: OptimizationParams) -> None:
        self.opt = opt
        self.extra_tasks = ()
        self.views_per_step = 1

    @property
    def iterations(self) -> int:
        """Number of steps; s = 1 .. iterations."""
        return -(-self.opt.iterations // self.views_per_step)

    @property
    def starts_from(self) -> str | None:
        """Name of the method whose trained scene this stage starts from (the runner supplies it).

        None: it goes on from the stage before.
        """
        return None

    @property
    def taught_by(self) -> tuple[str, ...]:
        """Names of further methods whose trained scenes it asks `context.trained` for (teachers).

        What a training depends on is known before it begins: a scene that no stage of the method names here or in
        `starts_from` is refused.
        """
        return ()

    @property
    def prefer(self) -> tuple[str, ...]:
        """Preferred rasterizers, if installed; the user's `raster.prefer` takes precedence."""
        return ()

    def random_background(self, step: int) -> bool:
        """Return whether this step uses a random background for render and image, whatever the run asks.

        It has none where `legacy_8bit_composite` has taken alpha away.
        """
        return False

    def looked_up(self, scene: Scene | None) -> dict[str, Any]:
        """Return values that the configuration leaves to the scene, by dotted key, JSON-able; None: its keys count."""
        return {}

    def begin(self, context: StageContext) -> SplatModel:
        """Return the model that this stage trains: the one it is given, or another built from it (masks, teacher).

        On resume it is called too, then every tensor is overwritten from the checkpoint: whatever must
        survive is a parameter, a buffer or in `state_dict_extra` of the returned model.
        """
        return context.model

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        """Return the optimizer, with parameter groups and learning rates."""
        raise NotImplementedError

    def create_sampler(self, scene: Scene, generator: torch.Generator) -> CameraSampler:
        """Return the sampler of training views."""
        return CameraSampler(scene.train, generator)

    def when(self, when: When) -> When:
        """Scale a plan of the full schedule to this run if `opt.scale_schedule`, else return it unchanged."""
        return scaled(when, self.opt.schedule_scale / self.views_per_step)

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        """Register a task that runs before rendering, at the steps of `self.when(plan of the full run)`."""

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        """Register a task between backward and the optimizer step, at the steps of `self.when(...)`."""

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        """Return the render options of this step. The last step must ask for every feature of any step."""
        return RasterOptions(background=background)

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        """Return the loss of this step. Default: 0.8 L1 + 0.2 (1 - SSIM) against the view's picture on `background`."""
        return photometric_loss(result.image, view.image(background, result.image.device))

    def running(self, state: TrainingState) -> AbstractContextManager[Any]:
        """Enclose the loop of steps, of a new state or a resumed one; what it does around them is not training time."""
        return nullcontext()

    def whole_step(self, state: Any, view: View, camera: Any, background: Tensor) -> Any:
        """Return a TrainingState's (RenderResult, LossPack), gradients made, faster than by parts; None: take these."""

    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        """Return the model that the next stage, or the encoder, gets; called once after the last step."""
        return model
