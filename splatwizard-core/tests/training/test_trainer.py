"""The five stages of a step: their order, what each sees, and how training ends when it goes wrong."""

import json
import math
from copy import copy
from dataclasses import replace

import pytest
import torch

from splatwizard_core.errors import (
    ConfigError,
    EmptyModel,
    NothingToDo,
    TaskError,
    TaskSignatureError,
    TrainingDiverged,
)
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.rendering.rasterizer import Rasterizer, RenderResult
from splatwizard_core.streams import Streams
from splatwizard_core.training import timing
from splatwizard_core.training.losses import LossPack
from splatwizard_core.training.optimizer import SplatOptimizer
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.pipeline import TrainingRun
from splatwizard_core.training.scheduler import STOP
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.trainer import Trainer


def make_stage(toy, *, iterations=10, pre=(), post=(), loss=None):
    """The toy stage with other tasks: (when, task) pairs."""

    class Own(toy.Stage):
        def register_pre_task(self, scheduler, ppl, opt):
            for when, task in pre:
                scheduler.register_task(when, task)

        def register_post_task(self, scheduler, ppl, opt):
            for when, task in post:
                scheduler.register_task(when, task)

        def loss(self, model, view, result, background, step):
            return (loss or super().loss)(model, view, result, background, step)

    return Own(OptimizationParams(iterations=iterations))


def make_trainer(toy, stage, *, scene=None, ppl=None):
    scene = scene or toy.scene
    return Trainer(
        TrainingState.begin(stage, toy.make_model(scene), scene, ppl or PipelineParams(), toy.Rasterizer(), Streams(0))
    )


def test_a_step_runs_its_stages_in_order(toy):
    order = []

    def before(model: GaussianModel):
        order.append(("pre", model.means.grad is None, torch.is_grad_enabled()))

    def after(model: GaussianModel, result: RenderResult, loss: LossPack, step: int):
        order.append(("post", model.means.grad is not None, torch.is_grad_enabled()))
        assert torch.equal(result.image.detach(), rendered[-1])
        assert math.isfinite(loss.parts["l1"].item())

    rendered = []

    def loss(model, view, result, background, step):
        order.append(("loss", model.means.grad is None, torch.is_grad_enabled()))
        rendered.append(result.image.detach().clone())
        return LossPack(result.image.mean(), {"l1": result.image.mean()})

    stage = make_stage(toy, pre=[(range(10), before)], post=[(range(10), after)], loss=loss)
    trainer = make_trainer(toy, stage)
    start = trainer.state.model.means.detach().clone()
    trainer.run(1, lambda record: None)
    assert order == [("pre", True, False), ("loss", True, True), ("post", True, False)]
    assert not torch.equal(trainer.state.model.means, start)
    assert trainer.state.model.means.grad is None


def test_the_last_step_makes_no_update(toy):
    trainer = make_trainer(toy, make_stage(toy, iterations=3))
    digests = [trainer.state.model.digest()]
    trainer.run(3, lambda record: digests.append(trainer.state.model.digest()))
    assert digests[1] != digests[0]
    assert digests[2] != digests[1]
    assert digests[3] == digests[2]
    assert trainer.state.optimizer.moments("means")[2] == 2


def test_a_replaced_parameter_is_not_updated_in_its_step(toy):
    def reset(model: GaussianModel, optimizer: SplatOptimizer):
        optimizer.replace(model, "opacity_logits", torch.full_like(model.opacity_logits, -1.0))

    trainer = make_trainer(toy, make_stage(toy, post=[(2, reset)]))
    trainer.run(1, lambda record: None)
    means = trainer.state.model.means.detach().clone()
    trainer.run(2, lambda record: None)
    assert (trainer.state.model.opacity_logits == -1).all()
    assert not torch.equal(trainer.state.model.means, means)
    assert trainer.state.optimizer.moments("opacity_logits")[2] == 1
    assert trainer.state.optimizer.moments("means")[2] == 2


def test_at_a_densification_nothing_is_updated(toy):
    def restructure(model: GaussianModel, optimizer: SplatOptimizer):
        optimizer.keep_rows(model, torch.arange(model.num_rows) > 0)

    trainer = make_trainer(toy, make_stage(toy, post=[(2, restructure)]))
    trainer.run(1, lambda record: None)
    before = {n: p.detach()[1:].clone() for n, p in trainer.state.model.named_parameters()}
    trainer.run(2, lambda record: None)
    for name, parameter in trainer.state.model.named_parameters():
        assert torch.equal(parameter, before[name])
        if name != "quats":  # the toy rasterizer's splats are round
            assert trainer.state.optimizer.moments(name)[2] == 1


def test_tasks_can_render_for_scores(toy):
    seen = []

    def score(model: GaussianModel, rasterizer: Rasterizer):
        seen.append(type(rasterizer).__name__)

    make_trainer(toy, make_stage(toy, pre=[(1, score)])).run(1, lambda record: None)
    assert seen == ["SoftRasterizer"]


@pytest.mark.parametrize("where", ["pre", "post"])
def test_stop_ends_training_after_the_whole_step(toy, where):
    trainer = make_trainer(toy, make_stage(toy, **{where: [(4, lambda: STOP)]}))
    steps = []
    trainer.run(10, lambda record: steps.append(record.step))
    assert steps == [1, 2, 3, 4]
    assert trainer.state.stopped
    assert trainer.state.optimizer.moments("means")[2] == 4


def test_a_loss_that_is_not_finite_names_step_camera_and_part(toy):
    def loss(model, view, result, background, step):
        fine = result.image.mean()
        bad = fine * (float("nan") if step == 3 else 1.0)
        return LossPack(fine + bad, {"l1": fine, "rate": bad})

    trainer = make_trainer(toy, make_stage(toy, loss=loss))
    views = []
    with pytest.raises(TrainingDiverged, match="at step 3: loss part 'rate' is nan") as info:
        trainer.run(10, lambda record: views.append(record.view))
    assert info.value.camera in {v.name for v in toy.scene.train} - set(views)
    assert all(p.isfinite().all() for p in trainer.state.model.parameters())


def test_an_infinite_total_of_finite_parts_is_named_total(toy):
    def loss(model, view, result, background, step):
        return LossPack(result.image.mean() * float("inf"), {"l1": result.image.mean()})

    with pytest.raises(TrainingDiverged, match="'total' is inf"):
        make_trainer(toy, make_stage(toy, loss=loss)).run(10, lambda record: None)


def test_losses_on_a_gpu_are_looked_at_in_batches_and_the_first_bad_one_is_named(toy):
    def loss(model, view, result, background, step):
        return LossPack(result.image.mean() * (float("nan") if step in (5, 7) else 1.0))

    trainer = make_trainer(toy, make_stage(toy, loss=loss))
    trainer.device = torch.device("meta")  # anything but a CPU: looks are batched
    trainer._camera = lambda view: view.camera
    trainer._background = torch.zeros(3)
    with pytest.raises(TrainingDiverged, match="at step 5"):
        trainer.run(10, lambda record: None)
    assert trainer.state.step == 10


@pytest.mark.parametrize("where", ["pre", "post"])
def test_pruning_everything_is_an_empty_model(toy, where):
    def prune(model: GaussianModel, optimizer: SplatOptimizer):
        optimizer.keep_rows(model, torch.zeros(model.num_rows, dtype=torch.bool))

    with pytest.raises(EmptyModel, match="step 2"):
        make_trainer(toy, make_stage(toy, **{where: [(2, prune)]})).run(10, lambda record: None)


def test_a_failing_task_is_named(toy):
    def fail():
        raise OSError("disk full")

    with pytest.raises(TaskError, match=r"task 'fail' \(pre\) failed at step 2: OSError: disk full"):
        make_trainer(toy, make_stage(toy, pre=[(2, fail)])).run(10, lambda record: None)


def test_a_task_for_another_model_fails_before_the_first_step(toy):
    class Other(GaussianModel):
        pass

    def task(model: Other):
        pass

    with pytest.raises(TaskSignatureError, match="wants Other, this run has PhasedModel"):
        make_trainer(toy, make_stage(toy, post=[(9, task)]))


def test_at_or_past_the_end_there_is_nothing_to_do(toy):
    trainer = make_trainer(toy, make_stage(toy, iterations=3))
    trainer.state.step = 3
    with pytest.raises(NothingToDo, match="ends at step 3, and 3 steps are done"):
        trainer.run(3, lambda record: None)


def test_the_fixed_background_is_the_scenes(toy):
    trainer = make_trainer(toy, make_stage(toy))
    trainer.run(3, lambda record: None)
    assert all(torch.equal(b, toy.scene.background) for b in trainer.state.rasterizer.backgrounds)


def test_a_random_background_and_pictures_composited_at_load_are_refused(toy):
    scene = toy.make_scene(rgba=True)
    scene.protocol = replace(scene.protocol, composite8=True)
    run = {"directory": None, "identity": {}, "trained": lambda method: None}
    given = [make_stage(toy)], lambda: None, scene
    TrainingRun(*given, PipelineParams(), None, **run)
    with pytest.raises(ConfigError, match="leave out one"):
        TrainingRun(*given, PipelineParams(random_background=True), None, **run)


def test_a_rasterizer_whose_sums_have_no_order_is_refused_by_name_before_the_first_step(toy):
    class Ordered(toy.Rasterizer):
        info = replace(toy.Rasterizer.info, features=toy.Rasterizer.info.features | {"DETERMINISTIC"})

    scene, run = toy.make_scene(), {"directory": None, "identity": {}, "trained": lambda method: None}
    for rasterizer, refused in ((toy.Rasterizer(), True), (Ordered(), False)):
        given = [make_stage(toy, iterations=2)], lambda: toy.make_model(scene), scene
        training = TrainingRun(*given, PipelineParams(deterministic=True), rasterizer, **run)
        if refused:
            with pytest.raises(ConfigError, match="deterministic=true: rasterizer 'soft' sums in any order on cpu"):
                training.train()
            assert not rasterizer.backgrounds
        else:
            training.train()
            assert len(rasterizer.backgrounds) == 2


def test_a_random_background_is_fresh_each_step_and_the_same_for_render_and_truth(toy):
    seen = []

    def loss(model, view, result, background, step):
        seen.append(background)
        # An RGBA view composited on the colour that was rendered on.
        truth = view.image(background)
        alpha = view.pixels[3:].float() / 255
        expected = view.pixels[:3].float() / 255 * alpha + background[:, None, None] * (1 - alpha)
        torch.testing.assert_close(truth, expected)
        return LossPack((result.image - truth).abs().mean())

    scene = toy.make_scene(rgba=True)
    trainer = make_trainer(toy, make_stage(toy, loss=loss), scene=scene, ppl=PipelineParams(random_background=True))
    trainer.run(5, lambda record: None)
    assert trainer.state.rasterizer.backgrounds == seen
    assert len({tuple(b.tolist()) for b in seen}) == 5
    assert all(((b >= 0) & (b < 1)).all() for b in seen)


def test_a_stage_may_ask_for_random_backgrounds_of_its_own(toy):
    stage = make_stage(toy)
    stage.random_background = lambda step: step <= 3
    trainer = make_trainer(toy, stage, scene=toy.make_scene(rgba=True))
    trainer.run(5, lambda record: None)
    *fresh, before_last, last = (tuple(b.tolist()) for b in trainer.state.rasterizer.backgrounds)
    assert len({*fresh, last}) == 4
    assert before_last == last == tuple(trainer.state.scene.background.tolist())


def test_clamp_render_cuts_the_image_before_the_loss(toy):
    images = []

    def loss(model, view, result, background, step):
        images.append(result.image)
        return LossPack(result.image.mean())

    def brighten(model: GaussianModel):
        model.sh_dc.fill_(30.0)

    for clamp in (False, True):
        stage = make_stage(toy, pre=[(1, brighten)], loss=loss)
        make_trainer(toy, stage, ppl=PipelineParams(clamp_render=clamp)).run(1, lambda record: None)
    assert images[0].max() > 1
    assert images[1].max() <= 1


def test_cameras_are_drawn_without_replacement(toy):
    views = []
    make_trainer(toy, make_stage(toy, iterations=13)).run(13, lambda record: views.append(record.view))
    everything = {v.name for v in toy.scene.train}
    assert set(views[:6]) == set(views[6:12]) == everything
    assert views[:6] != views[6:12]


def test_a_step_leaves_no_graph_behind(toy):
    trainer = make_trainer(toy, make_stage(toy))
    trainer.run(1, lambda record: None)
    assert trainer.state.result is None
    assert trainer.state.loss is None


def timed_stage(toy, now, iterations):
    """A stage whose pre task takes 1 s a step, drawing 2 s, the loss 4 s, its gradient 8 s, the post task 16 s."""

    class Timed(toy.Rasterizer):
        def render(self, *given):
            now[0] += 2
            return super().render(*given)

    class Slow(torch.autograd.Function):
        @staticmethod
        def forward(ctx, loss):
            now[0] += 4
            return loss.clone()

        @staticmethod
        def backward(ctx, gradient):
            now[0] += 8
            return gradient

    def pre(model: GaussianModel) -> None:
        now[0] += 1

    def post(model: GaussianModel) -> None:
        now[0] += 16

    def loss(model, view, result, background, step):
        return LossPack(Slow.apply((result.image - view.image(background)).abs().mean()))

    whole = range(iterations + 1)
    return make_stage(toy, iterations=iterations, pre=[(whole, pre)], post=[(whole, post)], loss=loss), Timed()


def test_stage_times_are_opt_in_and_add_up(toy, now):
    stage, rasterizer = timed_stage(toy, now, 20)
    assert toy.train([stage], rasterizer=rasterizer).figures.breakdown_s is None
    outcome = toy.train([stage], rasterizer=rasterizer, ppl=PipelineParams(profile="stages"))
    assert outcome.figures.breakdown_s["toy"] == {
        "pre": 20, "render": 40, "loss": 80, "backward": 160, "post": 320, "optimize": 0
    }  # fmt: skip
    assert list(outcome.figures.breakdown_s["toy"]) == list(timing.STAGES)
    assert outcome.figures.train_s == 620


def test_housekeeping_is_no_part_of_the_training_time(toy, now):
    def slow(*_):
        now[0] += 1000

    stage, rasterizer = timed_stage(toy, now, 20)
    outcome = toy.train([stage], rasterizer=rasterizer, on_step=slow, evaluate=slow, ppl=PipelineParams(eval_every=1))
    assert now[0] == 40 * 1000 + 620
    assert outcome.figures.train_s == 620
    assert outcome.figures.stage_seconds == {"toy": 620}


def test_an_evaluation_stands_beside_the_seconds_of_training_so_far(toy, now, tmp_path):
    def slow(*_):
        now[0] += 1000
        return {"psnr": 20.0}

    stage, rasterizer = timed_stage(toy, now, 20)
    toy.train([stage], rasterizer=rasterizer, evaluate=slow, directory=tmp_path, ppl=PipelineParams(eval_every=5))
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [line["train_s"] for line in lines if "metrics" in line] == [155, 310, 465, 620]


def test_a_record_has_what_the_log_shows(toy, tmp_path):
    records, rows = [], {}
    ppl = PipelineParams(log_every=7)

    def keep(model, state):
        records.append(copy(state))
        rows[state.step] = state.num_rows

    toy.train(iterations=30, on_step=keep, directory=tmp_path, ppl=ppl)
    assert [r.step for r in records] == list(range(1, 31))
    assert all(not r.total.requires_grad for r in records)
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    steps = [line for line in lines if "loss" in line]
    assert [line["step"] for line in steps] == [1, 7, 14, 21, 28, 30]
    by_step = {r.step: r for r in records}
    for line in steps:
        record = by_step[line["step"]]
        assert line["stage"] == 0
        assert line["view"] == record.view
        assert line["loss"] == record.total.item()
        assert line["parts"] == {"l1": record.parts["l1"].item()}
        assert line["num_gaussians"] == rows[record.step]
    assert steps[1]["lr"]["means"] == pytest.approx(1e-2 * (1e-4 / 1e-2) ** (7 / 200))
    # Tasks registered with log=True leave a line as well.
    assert [line["step"] for line in lines if line.get("task") == "densify"] == [20, 30]
