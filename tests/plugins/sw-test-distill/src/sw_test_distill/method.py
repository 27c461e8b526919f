"""Distillation: a borrowed 3DGS stage, then a masked student that learns from a frozen teacher on jittered views."""

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from splatwizard_core.api import (
    SH,
    Camera,
    CameraSampler,
    ContainerReader,
    ContainerWriter,
    GaussianInputs,
    GaussianModel,
    LossPack,
    Method,
    OptimizationParams,
    ParamGroup,
    Rasterizer,
    RasterOptions,
    RenderResult,
    Scene,
    SplatOptimizer,
    Stage,
    StageContext,
    View,
    create_method,
    photometric_loss,
)

OWN = ("means", "opacity_logits", "log_scales", "quats")


class TestDistillConfig(OptimizationParams):
    iterations: int = Field(25, ge=1, description="distillation steps")
    base_iterations: int = Field(25, ge=1, description="3DGS steps before")
    jitter: float = Field(0.05, ge=0, description="standard deviation of the camera centre, world units")
    mask_weight: float = Field(1e-2, ge=0, description="weight of the mask penalty")
    codebook: int = Field(64, ge=2, description="codes for the colours")


class MaskedStudent(GaussianModel):
    """A GaussianModel whose view-dependent colours a learnable binary mask switches off, and its frozen teacher."""

    ROWS = (*GaussianModel.ROWS, "mask_logits")

    def __init__(self, *tensors: Tensor, teacher: GaussianModel, active_sh_degree: int) -> None:
        super().__init__(*tensors, active_sh_degree=active_sh_degree)
        self.mask_logits = nn.Parameter(torch.zeros(self.means.shape[0]))
        self.teacher = teacher.requires_grad_(False)

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        drawn = super().gaussians(camera, rasterizer)
        soft = torch.sigmoid(self.mask_logits)
        mask = (soft > 0.5).float() + soft - soft.detach()
        sh = SH(dc=self.sh_dc, rest=self.sh_rest * mask[:, None, None], active_degree=self.active_sh_degree)
        return replace(drawn, sh=sh, extras={"mask": soft})


class JitteredSampler(CameraSampler):
    """Training poses; two of three steps move the camera centre. Those views have no picture."""

    def __init__(self, views: list[View], generator: torch.Generator, sigma: float) -> None:
        super().__init__(views, generator)
        self.sigma = sigma

    def next(self, step: int) -> View:
        view = super().next(step)
        if step % 3 == 0:
            return view
        camera = view.camera
        center = camera.center + self.sigma * torch.randn(3, generator=self.generator)
        return View(replace(camera, tau=-camera.R @ center), name=f"{view.name} (moved)")


class Distill(Stage):
    """Student against teacher; the photograph is not used."""

    name = "distill"
    opt: TestDistillConfig

    def begin(self, context: StageContext) -> MaskedStudent:
        self.rasterizer = context.rasterizer
        base = context.model
        tensors = [getattr(base, n).detach().clone() for n in
                   ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")]  # fmt: skip
        return MaskedStudent(*tensors, teacher=copy.deepcopy(base), active_sh_degree=base.max_sh_degree)

    def create_optimizer(self, model: MaskedStudent, scene: Scene) -> SplatOptimizer:
        rates = {"means": 1.6e-6 * scene.extent, "sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "opacity_logits": 0.05,
                 "log_scales": 5e-3, "quats": 1e-3, "mask_logits": 0.01}  # fmt: skip
        return SplatOptimizer(model, [ParamGroup(name, lr) for name, lr in rates.items()])

    def create_sampler(self, scene: Scene, generator: torch.Generator) -> CameraSampler:
        return JitteredSampler(scene.train, generator, self.opt.jitter)

    def loss(self, model: MaskedStudent, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        with torch.no_grad():
            options = RasterOptions(background=background)
            drawn = model.teacher.gaussians(view.camera, self.rasterizer)
            target = self.rasterizer.render(drawn, view.camera, options).image
        photometric = photometric_loss(result.image, target)
        mask = result.extras["mask"].mean()
        return LossPack(photometric.total + self.opt.mask_weight * mask, {**photometric.parts, "mask": mask.detach()})


class TestDistill(Method):
    name = "test-distill"
    Config = TestDistillConfig
    RATES = {"r1": {"codebook": 16}, "r2": {"codebook": 64}}
    DEFAULT_RATE = "r2"

    def _base(self) -> Method:
        return create_method(self.plugins, "3dgs", {"iterations": self.config.base_iterations})

    def create_model(self, scene: Scene, generator: torch.Generator) -> GaussianModel:
        return self._base().create_model(scene, generator)

    def stages(self) -> Sequence[Stage]:
        return [*self._base().stages(), Distill(self.config)]

    def encode(self, model: MaskedStudent, writer: ContainerWriter) -> None:
        rest = model.sh_rest.detach() * (model.mask_logits.detach() > 0)[:, None, None]
        colors = torch.cat([model.sh_dc.detach(), rest], dim=1).flatten(1)
        quantizer = self.plugins.quantizers.load("vq")(self.config.codebook)
        quantizer.fit(colors, generator=torch.Generator(colors.device).manual_seed(0))
        codes, side = quantizer.encode(colors)
        writer.add_array("codes", codes.cpu().numpy().astype("<u2"))
        writer.add_array("codebook", np.asarray(side["codebook"], dtype="<f4"))
        for name in OWN:
            writer.add_array(name, getattr(model, name).detach().cpu().numpy().astype("<f4"))

    def decode(self, reader: ContainerReader) -> GaussianModel:
        codes = torch.from_numpy(reader.array("codes", dtype="<u2", ndim=1).astype(np.int64))
        side = {"codebook": reader.array("codebook", dtype="<f4", ndim=2)}
        colors = self.plugins.quantizers.load("vq").decode(codes, side).reshape(len(codes), -1, 3)
        own = {name: torch.from_numpy(reader.array(name, dtype="<f4").copy()) for name in OWN}
        return GaussianModel.from_tensors(sh_dc=colors[:, :1], sh_rest=colors[:, 1:], **own)
