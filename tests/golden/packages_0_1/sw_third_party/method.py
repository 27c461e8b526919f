"""Opacity pruning: train 3DGS, drop the most transparent Gaussians, train on."""

from collections.abc import Sequence

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.experiments.method import Method, create_method
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.scene.scene import Scene
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.scheduler import Scheduler
from splatwizard_core.training.stage import Stage

TENSORS = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")


class OpacityPruneConfig(OptimizationParams):
    """Hyper-parameters of opacity pruning."""

    iterations: int = Field(5_000, ge=1, description="steps after pruning")
    base_iterations: int = Field(30_000, ge=1, description="steps of the 3DGS stage before it")
    base_preset: str = Field("paper", description="preset of the 3DGS stage")
    keep: float = Field(0.5, gt=0, le=1, description="fraction of the Gaussians that stay: the most opaque ones")


def most_opaque(opacity_logits: Tensor, keep: float) -> Tensor:
    """Mask [N] bool of the round(keep N) most opaque Gaussians, at least one; ties go to the lower index."""
    count = max(1, round(keep * len(opacity_logits)))
    order = torch.argsort(opacity_logits, descending=True, stable=True)
    mask = torch.zeros(len(opacity_logits), dtype=torch.bool, device=opacity_logits.device)
    mask[order[:count]] = True
    return mask


class PruneAndTrainOn(Stage):
    """Prune once before the first step, then fine-tune with constant learning rates."""

    name = "prune"
    opt: OpacityPruneConfig

    def create_optimizer(self, model: GaussianModel, scene: Scene) -> SplatOptimizer:
        return SplatOptimizer(
            model,
            [
                ParamGroup("means", 1.6e-6 * scene.extent),
                ParamGroup("sh_dc", 2.5e-3),
                ParamGroup("sh_rest", 1.25e-4),
                ParamGroup("opacity_logits", 0.05),
                ParamGroup("log_scales", 5e-3),
                ParamGroup("quats", 1e-3),
            ],
        )

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        scheduler.register_task(1, self.prune, name="prune by opacity")

    def prune(self, model: GaussianModel, optimizer: SplatOptimizer) -> None:
        optimizer.keep_rows(model, most_opaque(model.opacity_logits, self.opt.keep))


class OpacityPrune(Method):
    """The method: two stages, and a file of half-precision tensors."""

    name = "opacity-prune"
    Config = OpacityPruneConfig
    PRESETS = {"paper": {}, "quick": {"base_iterations": 1_000, "base_preset": "quick", "iterations": 200}}
    RATES = {"r1": {"keep": 0.25}, "r2": {"keep": 0.5}}
    DEFAULT_RATE = "r2"

    def _base(self) -> Method:
        return create_method(
            self.plugins, "3dgs", {"iterations": self.config.base_iterations}, preset=self.config.base_preset
        )

    def create_model(self, scene: Scene, generator: torch.Generator) -> GaussianModel:
        return self._base().create_model(scene, generator)

    def stages(self) -> Sequence[Stage]:
        return [*self._base().stages(), PruneAndTrainOn(self.config)]

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        writer.static = {"active_sh_degree": model.active_sh_degree}
        for name in TENSORS:
            writer.add_array(name, getattr(model, name).detach().cpu().numpy().astype("<f2"))

    def decode(self, reader: ContainerReader) -> GaussianModel:
        tensors = {name: reader.array(name, dtype="<f2").astype(np.float32) for name in TENSORS}
        model = GaussianModel.from_tensors(**{name: torch.from_numpy(array) for name, array in tensors.items()})
        model.active_sh_degree = int(reader.static["active_sh_degree"])
        return model
