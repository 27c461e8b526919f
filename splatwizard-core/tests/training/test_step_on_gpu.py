"""A training step on a GPU, played with fakes: late verdicts, pictures that are kept there, memory that runs out."""

import gc
import weakref

import pytest
import torch

from splatwizard_core.base.scalars import Verdict, read_scalars
from splatwizard_core.errors import DeviceMemoryError, TaskError, TrainingDiverged
from splatwizard_core.evaluation.evaluate import render_view
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.device import device_reason
from splatwizard_core.scene.images import keep_pictures
from splatwizard_core.streams import Streams
from splatwizard_core.training import trainer as trainer_module
from splatwizard_core.training.losses import LossPack
from splatwizard_core.training.optimizer import SplatOptimizer
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.trainer import CHECK_EVERY, Trainer

TWO_GIB = 2 << 30
TORCH_SAYS = "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total capacity of 8.00 GiB of which"


def as_if_on_gpu(toy, stage):
    """A trainer that looks at losses as it does on a GPU."""
    state = TrainingState.begin(
        stage, toy.make_model(toy.scene), toy.scene, PipelineParams(), toy.Rasterizer(), Streams(0)
    )
    trainer = Trainer(state)
    trainer.device = torch.device("meta")  # anything but a CPU
    trainer._camera = lambda view: view.camera
    trainer._background = torch.zeros(3)
    return trainer


def stage_with(toy, iterations, *, bad_at=(), post=()):
    class Own(toy.Stage):
        def register_pre_task(self, scheduler, ppl, opt):
            pass

        def register_post_task(self, scheduler, ppl, opt):
            for when, task in post:
                scheduler.register_task(when, task)

        def loss(self, model, view, result, background, step):
            return LossPack(result.image.mean() * (float("nan") if step in bad_at else 1.0))

    return Own(OptimizationParams(iterations=iterations))


@pytest.mark.parametrize("bad", [1, 5, CHECK_EVERY, CHECK_EVERY + 1, 3 * CHECK_EVERY])
def test_a_loss_that_is_not_finite_is_told_at_most_two_looks_later(toy, bad):
    trainer = as_if_on_gpu(toy, stage_with(toy, 1000, bad_at=(bad,)))
    with pytest.raises(TrainingDiverged, match=f"at step {bad}:"):
        trainer.run(1000, lambda record: None)
    assert bad <= trainer.state.step <= bad + 2 * CHECK_EVERY


def test_no_verdict_is_waited_for_when_it_is_asked(toy, monkeypatch: pytest.MonkeyPatch):
    asked_at, heard_at = [], []

    class Watched(Verdict):
        def __init__(self, totals):
            asked_at.append(trainer.state.step)
            super().__init__(totals)

        def fine(self):
            heard_at.append(trainer.state.step)
            return super().fine()

    monkeypatch.setattr(trainer_module, "Verdict", Watched)
    trainer = as_if_on_gpu(toy, stage_with(toy, 100))
    trainer.run(99, lambda record: None)
    assert asked_at[:3] == [CHECK_EVERY, 2 * CHECK_EVERY, 3 * CHECK_EVERY]
    assert heard_at[:2] == [2 * CHECK_EVERY, 3 * CHECK_EVERY]


def test_what_a_bad_loss_leads_to_is_not_told_in_its_place(toy):
    def prune(model: GaussianModel, optimizer: SplatOptimizer):
        optimizer.keep_rows(model, torch.zeros(model.num_rows, dtype=torch.bool))

    def fail():
        raise ValueError("probability is nan")

    for task in (prune, fail):
        with pytest.raises(TrainingDiverged, match="at step 3"):
            as_if_on_gpu(toy, stage_with(toy, 10, bad_at=(3,), post=[(4, task)])).run(10, lambda record: None)
    with pytest.raises(TaskError, match="probability"):
        as_if_on_gpu(toy, stage_with(toy, 10, post=[(4, fail)])).run(10, lambda record: None)


def test_scalars_are_read_in_their_order():
    values = [torch.tensor(0.1), torch.tensor([0.2], dtype=torch.float64), torch.tensor(3)]
    assert read_scalars(values) == [torch.tensor(0.1).item(), 0.2, 3.0]
    assert read_scalars([]) == []
    assert Verdict(values[:1]).fine()
    assert not Verdict([torch.tensor(1.0), torch.tensor(float("inf"))]).fine()


@pytest.mark.cuda
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs a GPU that is not the current one")
def test_a_verdict_is_waited_for_on_the_device_of_the_losses():
    losses, stream = [torch.ones((), device="cuda:1")], torch.cuda.current_stream("cuda:1")
    assert Verdict(losses).fine()  # memory of the host is set aside before
    with torch.cuda.device(1):
        torch.cuda._sleep(1_000_000_000)
        slept = stream.record_event()
    assert Verdict(losses).fine()
    assert slept.query()


@pytest.mark.parametrize("where", ["loss", "task"])
def test_out_of_memory_names_the_figures_and_leaves_the_run_resumable(toy, tmp_path, where):
    class Fails(toy.Stage):
        full = True

        def register_post_task(self, scheduler, ppl, opt):
            super().register_post_task(scheduler, ppl, opt)
            scheduler.register_task(25, self.grow)

        def grow(self):
            if self.full and where == "task":
                raise torch.cuda.OutOfMemoryError(TORCH_SAYS)

        def loss(self, model, view, result, background, step):
            if self.full and where == "loss" and step == 25:
                raise torch.cuda.OutOfMemoryError(TORCH_SAYS)
            return super().loss(model, view, result, background, step)

    def train(directory):
        return toy.train(
            [Fails(OptimizationParams(iterations=60))], directory=directory, ppl=PipelineParams(checkpoint_every=20)
        )

    with pytest.raises(DeviceMemoryError, match=r"step 25 .* gaussians at 12x10 .*2,147,483,648 bytes wanted") as info:
        train(tmp_path / "run")
    assert info.value.wanted == TWO_GIB
    assert info.value.exit_status == 1
    assert "last checkpoint" in str(info.value)
    Fails.full = False
    resumed, straight = train(tmp_path / "run"), train(tmp_path / "straight")
    assert resumed.figures.steps == 60
    assert resumed.model.digest() == straight.model.digest()


def test_pictures_are_kept_on_a_gpu_only_where_they_fit(toy, monkeypatch: pytest.MonkeyPatch):
    view = toy.scene.train[0]
    view.keep_on("meta")
    assert view.kept_on.type == "meta"
    assert view.image(device="meta").device.type == "meta"
    torch.testing.assert_close(view.image(), view.pixels.float() / 255, rtol=0, atol=0)
    view.keep_on("cpu")
    assert view.kept_on.type == "cpu"
    wanted = sum(v.pixels.numel() for v in toy.scene.train)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (4 * wanted - 1, 1 << 30))
    assert not keep_pictures(toy.scene.train, "cuda")
    assert not keep_pictures([], "cuda")
    assert not keep_pictures(toy.scene.train, "cpu")
    assert all(v.kept_on.type == "cpu" for v in toy.scene.train)
    assert toy.train(iterations=3).figures.pictures_in == "host"


def test_a_camera_that_is_moved_keeps_its_numbers(toy):
    camera = toy.scene.train[0].camera
    moved = camera.to("meta")  # its numbers could not be read from there
    assert moved.pose == (*camera.R.flatten().tolist(), *camera.tau.tolist())
    assert camera.to(dtype=torch.float64).pose == moved.pose  # float32 numbers are exact in float64
    doubled = camera.to(dtype=torch.float64)
    assert doubled.to(dtype=torch.float32).pose == moved.pose


def test_where_a_run_computes_is_told_with_the_reason(monkeypatch: pytest.MonkeyPatch):
    plugins, cpu = load_plugins(), torch.device("cpu")
    assert "(--device cpu)" in device_reason("cpu", cpu, plugins)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "torch sees no CUDA device" in device_reason("auto", cpu, plugins)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device=None: "Some GPU")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device=None: (1, 0))
    assert "no rasterizer can run on Some GPU" in device_reason("auto", cpu, plugins)
    told = device_reason("cuda", torch.device("cuda"), plugins)
    assert told.startswith("computing on cuda, Some GPU")
    assert "--device cuda" in told


def test_out_of_memory_in_an_evaluation_is_named_too(toy):
    class Full(toy.Rasterizer):
        def render(self, g, cam, opt):
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB. GPU 0 has")

    with pytest.raises(DeviceMemoryError, match="a view of 40 gaussians at 12x10") as info:
        render_view(toy.make_model(toy.scene), toy.scene.test[0].camera, Full(), RasterOptions())
    assert info.value.wanted == 20 << 20


def test_the_optimizers_memory_goes_with_the_training(toy):
    made = []

    class Watched(toy.Stage):
        def create_optimizer(self, model, scene):
            optimizer = super().create_optimizer(model, scene)
            made.append(weakref.ref(optimizer))
            return optimizer

    gc.disable()  # nobody may have to look for rings before a GPU's memory is free
    try:
        outcome = toy.train([Watched(OptimizationParams(iterations=5))])
        assert outcome.figures.steps == 5
        assert made[0]() is None
    finally:
        gc.enable()
