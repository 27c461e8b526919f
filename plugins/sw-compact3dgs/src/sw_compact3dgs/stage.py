"""The training stage: that of 3DGS with a mask in its densification and its loss, and codebooks for its last steps."""

from collections.abc import Mapping

from sw_gaussians.pictures import PictureSizes
from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.volume_mask import VolumeMaskedGaussians, mask_prune, prune_by_mask
from torch import Tensor

from splatwizard_core.api import (
    DensityControl,
    LossPack,
    OptimizationParams,
    ParamGroup,
    PipelineParams,
    RenderResult,
    Scene,
    Scheduler,
    SplatModel,
    SplatOptimizer,
    TrainingState,
    View,
)
from sw_compact3dgs.config import Compact3DGSConfig
from sw_compact3dgs.model import CompactGaussians

CODEBOOK_EPS = 1e-8
"""Adam's usual one: gradients of a mean over all Gaussians are tiny, with 1e-15 every entry would move a full step."""
WARM_UP = 0.01
FULL_PLAN = 30_000


class Compact3DGSStage(ThreeDGSStage):
    """Trains CompactGaussians."""

    name = "compact3dgs"

    def __init__(
        self, opt: Compact3DGSConfig, control: DensityControl | None = None, *, pictures: PictureSizes | None = None
    ) -> None:
        super().__init__(opt.base, control, pictures=pictures)
        self.opt = opt
        self.own = opt

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        lr, own = self.own.lr, self.own
        return SplatOptimizer(
            model,
            [
                ParamGroup("means", lr=lr.position_init * scene.extent),
                ParamGroup("opacity_logits", lr=lr.opacity),
                ParamGroup("log_scales", lr=lr.scales),
                ParamGroup("quats", lr=lr.quats),
                ParamGroup("mask_logits", lr=own.mask.lr),
                ParamGroup("color", lr=self.network_lr(1)),
                ParamGroup("scale_vq", lr=own.rvq.lr, eps=CODEBOOK_EPS),
                ParamGroup("quat_vq", lr=own.rvq.lr, eps=CODEBOOK_EPS),
            ],
        )

    def network_lr(self, step: int) -> float:
        """Learning rate of grid and network at a step: linear warm-up, then a factor after each milestone."""
        network, done = self.own.network, step - 1  # updates before this step
        warm_up = self.steps(network.warm_up)
        rising = WARM_UP + (1 - WARM_UP) * min(done / warm_up, 1.0) if warm_up else 1.0
        passed = sum(done >= self.steps(milestone) for milestone in network.lr_steps)
        return network.lr * rising * network.lr_factor**passed

    def update_network_lr(self, optimizer: SplatOptimizer, step: int) -> None:
        """Set the learning rate of grid and network."""
        optimizer.set_lr("color", self.network_lr(step))

    def switch_to_rvq(self, model: CompactGaussians) -> None:
        """Make the codebooks, and render with them from this step on."""
        model.fit_codebooks(iterations=1)

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        super().register_pre_task(scheduler, ppl, opt)
        scheduler.register_task(
            self.when(range(self.own.lr.max_steps)), self.update_network_lr, name="update network lr"
        )
        scheduler.register_task(self.when(self.own.rvq.start), self.switch_to_rvq, name="switch to RVQ training")

    def adjust(self, state: TrainingState) -> Mapping[str, int]:
        """Clone, split and prune, and in the same step remove what the mask turned off."""
        report = super().adjust(state)
        assert isinstance(state.model, VolumeMaskedGaussians)
        return {**report, "masked": prune_by_mask(state.model, state.optimizer, step=state.step)}

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        super().register_post_task(scheduler, ppl, opt)
        removals = range(self.control.until, FULL_PLAN, self.own.mask.interval)
        scheduler.register_task(self.when(removals), mask_prune, name="mask prune")

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        """The photometric loss, the mean mask, and once there are codebooks their own loss, which moves them alone."""
        assert isinstance(model, CompactGaussians)
        pack, mask = super().loss(model, view, result, background, step), self.own.mask
        parts = {"mask": model.rate.share(result.extras["mask"])}
        total = pack.total + mask.weight * mask.factor * parts["mask"]
        if "codebooks" in result.extras:
            parts["codebooks"] = result.extras["codebooks"]
            total = total + parts["codebooks"]
        return LossPack(total, {**pack.parts, **{name: part.detach() for name, part in parts.items()}})
