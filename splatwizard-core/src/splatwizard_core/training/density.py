"""The contract of density controls: how a set of primitives grows and shrinks while it trains."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from splatwizard_core.training.params import Params

if TYPE_CHECKING:
    from splatwizard_core.gaussians.splat_model import SplatModel
    from splatwizard_core.rendering.rasterizer import RenderResult
    from splatwizard_core.training.losses import LossPack
    from splatwizard_core.training.plan import When
    from splatwizard_core.training.stage import StageContext
    from splatwizard_core.training.state import TrainingState

    DensityReport = Mapping[str, int]  # curve of the log -> primitives that changed: {"cloned": 12, "pruned": 3}
    DensityTask = tuple[str, When | None, Callable[..., DensityReport | None]]  # name, steps (None: all), action


class DensityControl:
    """Base of density controls: a subclass implements `rounds` (when) and `adjust` (how); the rest is optional.

    Steps are those of the full run; the last one of a run is left out. Statistics with a row for each primitive are
    buffers in `model.ROWS`: they follow rows that come and go.

    Settings    pydantic model of its settings, each with a default: `--set density.settings.KEY=VALUE`
    regularises its loss reaches what no view shows, so that the optimizer has to update all rows
    when        plan of the full run -> the same in steps of this run; set by the stage that uses the control
    """

    Settings: ClassVar[type[Params]] = Params
    regularises: ClassVar[bool] = False

    def __init__(self, **settings: Any) -> None:
        self.settings: Any = self.Settings(**settings)
        self.when: Callable[[When], When] = lambda when: when

    @property
    def rounds(self) -> range:
        """Steps at which `adjust` runs."""
        raise NotImplementedError

    @property
    def until(self) -> int:
        """First step without any collection or adjustment."""
        return self.rounds.stop

    def needs(self, step: int) -> frozenset[str]:
        """Return the `RasterOptions` that a step of this run has to draw with, such as {"grad2d"}."""
        return frozenset()

    def start_values(self) -> dict[str, float]:
        """Return the first `opacity` and `scale_factor` of Gaussians, where they are not those of 3DGS."""
        return {}

    def begin(self, state: StageContext) -> None:
        """Prepare a new or resumed training. Raises ConfigError for an unsuitable model."""

    def regularised(self, loss: LossPack, result: RenderResult, step: int) -> LossPack:
        """Return the loss of a step of this run with the control's own terms."""
        return loss

    def after_backward(self, state: TrainingState, result: RenderResult) -> None:
        """Collect statistics of one render; its gradients exist."""

    def adjust(self, state: TrainingState) -> DensityReport:
        """Change the rows of `state.model` with `state.optimizer`. Raises EmptyModel if nothing would be left."""
        raise NotImplementedError

    def pre_tasks(self) -> Iterable[DensityTask]:
        """Return the control's tasks that run first in a step, right after the previous step's update."""
        return ()

    def post_tasks(self) -> Iterable[DensityTask]:
        """Return the control's tasks between backward and update, in order.

        An action takes the state; one that takes (state, result) collects: it leaves model and gradients alone.
        """
        yield "collect statistics", range(self.until), self.after_backward
        yield "adjust density", self.rounds, self.adjust

    def finish(self, model: SplatModel) -> None:
        """Remove from the trained model what `begin` added."""

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint has to hold besides the model: tensors and JSON-able values."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
