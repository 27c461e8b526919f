"""Every schedule task of ours can be put into a plan by `[[tasks]]`."""

import pytest
from small_scene import small_scene, ten_gaussians
from sw_reference.rasterizer import ReferenceRasterizer

from splatwizard_core.errors import TaskSignatureError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours
from splatwizard_core.streams import Streams
from splatwizard_core.training.added_tasks import add_tasks
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from splatwizard_core.training.params import AddedTask, OptimizationParams, PipelineParams
from splatwizard_core.training.scheduler import build_schedulers
from splatwizard_core.training.stage import Stage
from splatwizard_core.training.state import TrainingState

NEEDED = {
    "average-parameters": {"first": 10, "last": 30},
    "dash": {"full_at": 20},
    "lead-to-size": {"size": "1MB", "method": "hac", "first": 10, "last": 90},
    "settle-learning-rates": {"rates": {"means": 1e-3}, "first": 10, "last": 20},
}
"""Settings without a default."""
OTHER_MODELS = {"mask-prune": "VolumeMaskedGaussians"}
"""Tasks for models of one family."""
TASKS = [entry.name for entry in load_plugins().tasks if is_ours(entry.distribution)]


class PlainStage(Stage):
    def create_optimizer(self, model, scene):
        return SplatOptimizer(model, [ParamGroup("means", 0.1)])


@pytest.mark.parametrize("name", TASKS)
def test_it_is_in_the_plan_of_a_stage_that_knows_nothing_of_it(name):
    asked = AddedTask(name=name, steps="range(10, 40, 10)", settings=NEEDED.get(name, {}))
    (stage,) = add_tasks([PlainStage(OptimizationParams(iterations=100))], [asked], load_plugins())
    pre, post = build_schedulers(stage, PipelineParams())
    assert post.plan_lines() == [f"post | {name} | range(10, 40, 10) | priority 0"]
    assert pre.plan_lines() == []
    scene = small_scene()
    model = ten_gaussians(scene)

    def begin() -> None:
        """Raise TaskSignatureError unless everything that a task asks for is there."""
        TrainingState.begin(stage, model, scene, PipelineParams(), ReferenceRasterizer(), Streams(0))

    if name in OTHER_MODELS:
        with pytest.raises(TaskSignatureError, match=f"wants {OTHER_MODELS[name]}, this run has GaussianModel"):
            begin()
    else:
        begin()


def test_there_are_some():
    assert len(TASKS) >= 10
