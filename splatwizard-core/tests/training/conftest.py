"""A scene, a rasterizer and a stage that are small enough to train hundreds of steps in a second."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from sw_anchors.phase_switch import PhaseSwitch
from sw_gaussians import density
from sw_gaussians.learning_rate import exponential_lr
from sw_gaussians.stage import increase_sh_degree
from sw_gaussians.start import gaussians_from_points
from sw_gaussians.statistics import accumulate_statistics

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.rendering.info import RasterizerInfo
from splatwizard_core.rendering.rasterizer import GradBuffer, RasterOptions, RenderResult
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.training import timing
from splatwizard_core.training.losses import LossPack
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.stage import Stage

WIDTH, HEIGHT = 12, 10


class SoftRasterizer:
    """Blends isotropic splats by normalised weights: no sorting, no tiles, differentiable in every input."""

    info = RasterizerInfo("soft", frozenset({"cpu"}), frozenset({"float32"}), frozenset({"BACKWARD"}))

    def __init__(self):
        self.backgrounds = []

    def render(self, g, cam, opt):
        self.backgrounds.append(opt.background)
        t = g.means @ cam.R.T + cam.tau
        uv = torch.stack([cam.fx * t[:, 0] / t[:, 2] + cam.cx, cam.fy * t[:, 1] / t[:, 2] + cam.cy], dim=1)
        grad2d = None
        if opt.grad2d and uv.requires_grad:
            grad2d = GradBuffer()
            uv.register_hook(lambda d: grad2d.set(d * d.new_tensor([cam.width / 2, cam.height / 2])))
        y, x = torch.meshgrid(torch.arange(cam.height) + 0.5, torch.arange(cam.width) + 0.5, indexing="ij")
        pixels = torch.stack([x, y], dim=-1).reshape(-1, 1, 2)
        sigma = g.scales.mean(dim=1) * cam.fx / t[:, 2] + 0.5
        falloff = torch.exp(-((pixels - uv) ** 2).sum(-1) / (2 * sigma**2))  # [P,N]
        weights = g.opacities * falloff
        bands = (g.sh.active_degree + 1) ** 2
        color = 0.5 + 0.28 * g.sh.dc[:, 0] + 0.1 * g.sh.rest[:, : bands - 1].sum(dim=1)
        background = torch.zeros(3) if opt.background is None else opt.background
        image = (weights @ color + 0.1 * background) / (weights.sum(1, keepdim=True) + 0.1)
        radii = (3 * sigma).ceil().int()
        return RenderResult(image.T.reshape(3, cam.height, cam.width), radii, g, grad2d=grad2d)

    def visible_filter(self, g, cam):
        return torch.ones(len(g), dtype=torch.int32)

    def accumulate(self, g, cams, opt):
        raise NotImplementedError


def make_scene(views=6, rgba=False, points=40, radius=3.0):
    generator = torch.Generator().manual_seed(7)
    made = []
    for i in range(views):
        angle = 2 * math.pi * i / views
        camera = Camera.look_at(
            torch.tensor([radius * math.cos(angle), radius * math.sin(angle), 1.0]),
            torch.zeros(3),
            torch.tensor([0.0, 0.0, 1.0]),
            width=WIDTH,
            height=HEIGHT,
            fov_x=0.8,
        )
        channels = 4 if rgba else 3
        pixels = torch.randint(0, 256, (HEIGHT, WIDTH, channels), generator=generator).numpy().astype(np.uint8)
        made.append(View(camera, f"view{i}.png", lambda pixels=pixels: pixels))
    cloud = PointCloud(torch.rand(points, 3, generator=generator) - 0.5, torch.rand(points, 3, generator=generator))
    return Scene("toy", made, made[:1], cloud, Protocol("toy"))


class PhasedModel(GaussianModel):
    """Explicit Gaussians with a mode flag: in phase "noisy", opacities are jittered by the global generator."""

    phase = "plain"

    def gaussians(self, camera, rasterizer):
        inputs = super().gaussians(camera, rasterizer)
        if self.phase == "noisy" and self.training:
            inputs.opacities = inputs.opacities * (1 + 0.01 * torch.rand_like(inputs.opacities))
        return inputs

    def state_dict_extra(self):
        return {**super().state_dict_extra(), "phase": self.phase}

    def load_state_dict_extra(self, extra):
        super().load_state_dict_extra(extra)
        self.phase = extra["phase"]


def make_model(scene, cls=PhasedModel):
    tensors = dict(gaussians_from_points(scene.points, max_sh_degree=1).named_parameters())
    return cls.from_tensors(**tensors, active_sh_degree=0)


class UpdateRate:
    def __call__(self, optimizer: SplatOptimizer, step: int) -> None:
        optimizer.set_lr("means", exponential_lr(step, init=1e-2, final=1e-4, max_steps=200))


def collect(model: GaussianModel, result: RenderResult) -> None:
    accumulate_statistics(model, result.grad2d.value, result.radii)


def densify(model: GaussianModel, optimizer: SplatOptimizer, step: int) -> None:
    density.densify_and_prune(model, optimizer, step=step, extent=1.0, grad_threshold=2e-3)


def reset(model: GaussianModel, optimizer: SplatOptimizer) -> None:
    density.reset_opacity(model, optimizer, ceiling=0.05)


def increase_degree(model: GaussianModel) -> None:
    increase_sh_degree(model)


class ToyStage(Stage):
    """The 3DGS plan in small: rate, SH degree, a mode switch, densification, opacity reset."""

    name = "toy"

    def create_optimizer(self, model, scene):
        names = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")
        return SplatOptimizer(model, [ParamGroup(name, 1e-2) for name in names])

    def register_pre_task(self, scheduler, ppl, opt):
        scheduler.register_task(range(200), UpdateRate(), name="update lr")
        scheduler.register_task(range(0, 200, 30), increase_degree, name="increase SH degree")
        PhaseSwitch(45, "noisy").register(scheduler)

    def register_post_task(self, scheduler, ppl, opt):
        scheduler.register_task(range(150), collect)
        scheduler.register_task(range(20, 150, 10), densify, log=True)
        scheduler.register_task(range(0, 150, 60), reset)

    def raster_options(self, step, background):
        return RasterOptions(background=background, grad2d=True)

    def loss(self, model, view, result, background, step):
        error = (result.image - view.image(background)).abs().mean()
        return LossPack(error, {"l1": error})


@pytest.fixture(autouse=True)
def one_thread():
    """Tensors of a few hundred numbers: threads only cost."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def now(monkeypatch):
    """The clock of a training, `now[0]` in seconds: it stands still until a test moves it."""
    now = [0.0]
    monkeypatch.setattr(timing, "work_time", lambda: now[0])
    return now


@pytest.fixture
def toy(tmp_path):
    """Everything by name, and `train(**overrides)`, which runs TrainingRun on it."""
    from splatwizard_core.training.pipeline import TrainingRun

    scene = make_scene()

    def train(stages=None, *, iterations=60, ppl=None, scene=scene, rasterizer=None, model=None, **options):
        if stages is None:
            stages = [ToyStage(OptimizationParams(iterations=iterations))]
        options = {"directory": None, "identity": {"method": "toy"}, "trained": None, **options}
        return TrainingRun(
            stages,
            (lambda: make_model(scene)) if model is None else model,
            scene,
            ppl or PipelineParams(checkpoint_every=1000),
            rasterizer or SoftRasterizer(),
            **options,
        ).train()

    return SimpleNamespace(
        train=train,
        scene=scene,
        make_scene=make_scene,
        make_model=make_model,
        Stage=ToyStage,
        Rasterizer=SoftRasterizer,
        Model=PhasedModel,
    )
