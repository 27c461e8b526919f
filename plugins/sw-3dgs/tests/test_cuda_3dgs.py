"""A training step of 3DGS on a GPU: it waits for nothing, and the statistics are those of the CPU."""

import math

import pytest
import torch
from sw_gaussians.density import fragments
from sw_gaussians.density.mcmc import draw
from sw_gaussians.fast.fused_adam import FusingOptimizer
from sw_gaussians.fast.statistics import accumulate_fragments
from sw_gaussians.native import GAUSSIANS
from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.start import gaussians_from_points
from sw_gaussians.statistics import accumulate_in_torch, accumulate_statistics

from splatwizard_core.base.random_states import seeded
from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.images import keep_pictures
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.streams import Streams, stream
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.stage import StageContext
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.trainer import CHECK_EVERY, Trainer
from splatwizard_native.fused.native import TRAINING
from sw_3dgs.config import ThreeDGSConfig

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
    pytest.mark.skipif(TRAINING.available(cuda=True) is not None, reason=str(TRAINING.available(cuda=True))),
]


def small_scene(channels: int) -> Scene:
    generator = torch.Generator().manual_seed(3)
    views = []
    for i in range(6):
        angle = 2 * math.pi * i / 6
        eye = torch.tensor([3 * math.cos(angle), 3 * math.sin(angle), 1.0])
        camera = Camera.look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]), width=64, height=48, fov_x=0.8)
        pixels = torch.randint(0, 256, (48, 64, channels), generator=generator, dtype=torch.uint8).numpy()
        views.append(View(camera, f"view{i}.png", lambda pixels=pixels: pixels))
    points = PointCloud(torch.rand(500, 3, generator=generator) - 0.5, torch.rand(500, 3, generator=generator))
    return Scene("small", views, views[:1], points, Protocol("toy"))


def make_trainer(
    scene: Scene, config: ThreeDGSConfig | None = None, *, fuses: bool | None = False, **settings
) -> Trainer:
    config = config or ThreeDGSConfig(iterations=7000)
    plugins = load_plugins()
    pictures = config.pictures.load(plugins)
    stage = ThreeDGSStage(config, config.density.load(plugins), pictures=pictures, fuses_updates=fuses)
    ppl, streams = PipelineParams(device="cuda", **settings), Streams(0)
    rasterizer = NegotiatedRasterizer(load_plugins(), device="cuda")
    assert scene.points is not None
    model = stage.begin(
        StageContext(gaussians_from_points(scene.points).cuda(), scene, ppl, rasterizer, streams, lambda name: None)
    )
    return Trainer(TrainingState.begin(stage, model, scene, ppl, rasterizer, streams))


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("random_background", [False, True])
def test_a_step_between_densifications_waits_for_nothing_that_torch_sees(channels, random_background):
    scene = small_scene(channels)
    assert keep_pictures(scene.train, "cuda")
    waits_for_nothing(make_trainer(scene, random_background=random_background))
    keep_pictures(scene.train, "cpu")


@pytest.mark.parametrize(
    "settings",
    [
        {"density": "mcmc"},
        {"sparse_adam": True},
        {"density": "budget"},
    ],
    ids=["mcmc", "sparse", "fast"],
)
def test_nor_does_it_with_noise_sparse_updates_or_opacity_gradients(settings):
    scene = small_scene(3)
    assert keep_pictures(scene.train, "cuda")
    waits_for_nothing(make_trainer(scene, ThreeDGSConfig.model_validate({"iterations": 7000, **settings})))
    keep_pictures(scene.train, "cpu")


def waits_for_nothing(trainer: Trainer) -> None:
    losses = []
    trainer.run(2 * CHECK_EVERY, lambda state: losses.append(state.total))
    torch.cuda.set_sync_debug_mode("error")
    try:
        while trainer.state.step < 4 * CHECK_EVERY:  # verdicts on the losses are among them
            trainer.run_step()
            losses.append(trainer.state.total)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    trainer.check_losses()
    assert all(math.isfinite(loss.item()) for loss in losses)
    assert trainer.state.optimizer.moments("means")[2] == 4 * CHECK_EVERY  # every step has updated


PLAN = {"start": 60, "interval": 40, "grad_threshold": 5e-5, "reset_interval": 150}
DENSE = {"density": {"settings": PLAN}, "iterations": 7000}
CHAIN = {"density": {"name": "mcmc", "settings": {"start": 60, "interval": 40, "cap": 700}}, "iterations": 7000}
BUDGET = {**PLAN, "opacity": "halve", "morton": True, "growth": 2.0}
FAST_PLAN = {"density": {"name": "budget", "settings": BUDGET}, "iterations": 7000}


@pytest.mark.parametrize(
    "values",
    [
        DENSE,
        {**DENSE, "sparse_adam": True},
        CHAIN,
        FAST_PLAN,
        {**FAST_PLAN, "pictures": {"schedule": "dash"}},
    ],
    ids=["dense", "sparse", "mcmc", "fast", "fast-dash"],
)
def test_two_deterministic_trainings_give_the_same_bits(values):
    config = ThreeDGSConfig.model_validate(values)
    outcomes = []
    for _ in range(2):
        losses = []
        with seeded(0, deterministic=True):
            trainer = make_trainer(small_scene(3), config, deterministic=True)
            trainer.run(250, lambda record, losses=losses: losses.append(record.total))
        outcomes.append(
            (torch.stack(losses), dict(trainer.state.model.named_parameters()), trainer.state.optimizer.states)
        )
    (losses, parameters, states), (others, theirs, other_states) = outcomes
    assert torch.equal(losses, others)
    assert len(parameters["means"]) != 500  # densification took part
    for name, parameter in parameters.items():
        assert torch.equal(parameter, theirs[name]), name
        for key, moment in states[name].tensors.items():
            assert torch.equal(moment, other_states[name].tensors[key]), (name, key)


@pytest.mark.parametrize("values", [DENSE, CHAIN], ids=["dense", "mcmc"])
def test_updates_in_the_backward_pass_are_those_of_the_optimizer(values, monkeypatch):
    """Adam makes a step of a tiny gradient as large as of any: what rounding moves is bounded by the learning rate."""
    # The degree rises to 3 within the steps: every band is trained, and has been zero before.
    config, outcomes, fused = ThreeDGSConfig.model_validate({**values, "sh_interval": 10}), [], []
    step = FusingOptimizer.step

    def spy(self, result=None):
        fused.append(self.model.sh_rest.grad is None and self.model.means.grad is not None)
        step(self, result)

    monkeypatch.setattr(FusingOptimizer, "step", spy)
    for fuses in (False, True):
        with seeded(0, deterministic=True):
            trainer = make_trainer(small_scene(3), config, fuses=fuses, deterministic=True)
            trainer.run(50, lambda record: None)
        outcomes.append(trainer)
        assert sum(fused) == (49 if fuses else 0)  # the moments exist from the first update on
        fused.clear()
    plain, other = (trainer.state for trainer in outcomes)
    for name, parameter in plain.model.named_parameters():
        mine, theirs = parameter.detach(), dict(other.model.named_parameters())[name].detach()
        assert float(mine.norm()) > 0
        assert float((mine - theirs).norm() / mine.norm()) < 1e-5, name
        assert plain.optimizer.states[name].step == other.optimizer.states[name].step == 50
    assert float(plain.model.sh_dc.detach().std()) > 0


def test_mcmc_grows_to_its_cap_with_what_it_draws_on_the_cpu():
    chain = {"name": "mcmc", "settings": {"start": 20, "interval": 20, "cap": 600}}
    trainer = make_trainer(small_scene(3), ThreeDGSConfig.model_validate({"iterations": 200, "density": chain}))
    trainer.run(200, lambda record: None)
    assert trainer.state.model.num_rows == 600
    assert all(torch.isfinite(p).all() for p in trainer.state.model.parameters())
    weights = torch.rand(5000, generator=torch.Generator().manual_seed(1))
    drawn = [draw(weights.to(device), 300, stream(1, "draw")).cpu() for device in ("cpu", "cuda")]
    assert torch.equal(*drawn)


def test_statistics_of_one_launch_are_those_of_many():
    generator = torch.Generator().manual_seed(5)
    assert small_scene(3).points is not None
    ours, theirs = (gaussians_from_points(small_scene(3).points).cuda() for _ in range(2))
    for _ in range(3):
        gradients = torch.randn(500, 2, generator=generator).cuda()
        radii = torch.randint(-1, 20, (500,), generator=generator, dtype=torch.int32).cuda()
        gradients[radii <= 0] = float("nan")
        accumulate_statistics(ours, gradients, radii)
        accumulate_in_torch(theirs, gradients, radii)
    for name in ("grad_accum", "denom", "max_radii2d"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=1e-6, atol=0)
    accumulate_statistics(ours, gradients.double(), radii)  # what no kernel takes goes the other way
    assert ours.denom.sum() > theirs.denom.sum()


def test_sums_over_fragments_of_one_launch_are_those_of_many():
    assert GAUSSIANS.has_cuda(), "built without CUDA"
    generator = torch.Generator().manual_seed(6)
    ours, theirs = (torch.zeros(500, 3, device="cuda") for _ in range(2))
    for _ in range(3):
        gradients, logits = (torch.randn(500, generator=generator).cuda() for _ in range(2))
        logits[:4] = torch.tensor([-40.0, 17.0, 90.0, float("nan")])
        found = torch.rand(500, 2, generator=generator).cuda()
        assert accumulate_fragments(ours, gradients, logits, found, least_clear=fragments.MIN_TRANSPARENCY)
        fragments.accumulate_fragments_in_torch(theirs, gradients, logits, found)
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6, equal_nan=True)
    assert ours[3, 0].isnan()
    assert ours[:3].isfinite().all()
    fragments.accumulate_fragments(ours, gradients, logits, found.double())  # what no kernel takes goes the other way
    fragments.accumulate_fragments_in_torch(theirs, gradients, logits, found)
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6, equal_nan=True)


def test_a_picture_on_a_gpu_is_the_one_on_the_host():
    view = small_scene(4).train[0]
    background = torch.tensor([1.0, 0.5, 0.0])
    view.keep_on("cuda")
    torch.testing.assert_close(
        view.image(background, "cuda").cpu(), view.image(background), rtol=0, atol=2.5e-7
    )  # 255 as a factor there, as a divisor here
