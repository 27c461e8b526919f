"""A stranger's plugin: a method, a pruner and a coder of vectors that chimerags knows nothing of."""

from collections.abc import Sequence

import numpy as np
from sw_gaussians.finetune.fine_tuning import FineTuningRates, FineTuningStage
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.method import Method
from splatwizard_core.plugins import Registry, hookimpl
from splatwizard_core.training.params import OptimizationParams


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("theirs", "their_parts:Theirs", summary="learns for a few steps", presets=["paper"], rates=["r1"])


@hookimpl
def register_pruners(registry: Registry) -> None:
    registry.add("their-order", "their_parts:TheirOrder", summary="the last rows matter most")


@hookimpl
def register_coders(registry: Registry) -> None:
    registry.add("their-vectors", "their_parts:TheirVectors", codes="vectors", summary="float32 as they are")


class TheirConfig(OptimizationParams):
    FULL_ITERATIONS = 5
    iterations: int = 5
    nudge: float = 0.0


class TheirStage(FineTuningStage):
    name = "theirs"
    starts_from = None

    def finish(self, model, scene):
        model.opacity_logits.data += self.opt.nudge
        return model


class Theirs(Method):
    name = "theirs"
    Config = TheirConfig

    def create_model(self, scene, generator):
        return gaussians_from_points(scene.points)

    def stages(self) -> Sequence[TheirStage]:
        return [TheirStage(self.config, FineTuningRates())]


class TheirOrder:
    uses_statistics = False

    def score(self, model, cameras, rasterizer, background=None):
        return model.means.new_tensor(range(model.num_rows))


class TheirVectors:
    def __init__(self, plugins) -> None:
        pass

    def encode(self, vectors, importance, seed=0):
        return {"all": vectors.astype("<f4").tobytes(), "most": str(int(np.argmax(importance))).encode()}

    def decode(self, parts, n, d):
        return np.frombuffer(parts["all"], "<f4").reshape(n, d)
