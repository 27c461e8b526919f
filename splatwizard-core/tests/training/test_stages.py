"""Several stages in a row: what each begins with, what is borrowed, and resuming in any of them."""

import copy

import pytest
import torch
from sw_gaussians.wrapped_stage import WrappedStage
from torch import nn

from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.training.losses import LossPack
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.pipeline import TrainingStopped
from splatwizard_core.training.scheduler import build_schedulers
from splatwizard_core.training.stage import CameraSampler, Stage


class Masked(SplatModel):
    """A trained model behind a learnable mask, and a frozen teacher."""

    ROWS = ("inner.means", "mask_logits")

    def __init__(self, inner, teacher):
        super().__init__()
        self.inner = inner
        self.teacher = teacher.requires_grad_(False)
        self.mask_logits = nn.Parameter(torch.zeros(inner.num_rows))

    @property
    def num_rows(self):
        return self.mask_logits.shape[0]

    def gaussians(self, camera, rasterizer):
        inputs = self.inner.gaussians(camera, rasterizer)
        mask = torch.sigmoid(self.mask_logits)
        inputs.opacities = inputs.opacities * mask
        inputs.extras["mask"] = mask
        return inputs

    def state_dict_extra(self):
        return {"inner": self.inner.state_dict_extra()}

    def load_state_dict_extra(self, extra):
        self.inner.load_state_dict_extra(extra["inner"])


class BackwardSampler(CameraSampler):
    """Views from last to first, with state of its own."""

    position = 0

    def next(self, step):
        self.position += 1
        return self.views[-self.position % len(self.views)]

    def state_dict(self):
        return {"position": self.position, "count": torch.tensor(self.position)}

    def load_state_dict(self, state):
        assert int(state["count"]) == state["position"]
        self.position = state["position"]


class MaskStage(Stage):
    name = "mask"
    taught_by = ("other",)

    def begin(self, context):
        teacher = context.trained("other")
        noise = torch.rand(1, generator=context.generator("method")).item()
        model = Masked(context.model, copy.deepcopy(teacher))
        with torch.no_grad():
            model.mask_logits.fill_(noise)
        self.noise = context.generator("method")
        return model

    def create_optimizer(self, model, scene):
        return SplatOptimizer(model, [ParamGroup("mask_logits", 0.05), ParamGroup("inner", 1e-3)])

    def create_sampler(self, scene, generator):
        return BackwardSampler(scene.train, generator)

    def loss(self, model, view, result, background, step):
        jitter = 0.01 * torch.rand(1, generator=self.noise).item()
        error = (result.image - view.image(background)).abs().mean()
        size = result.extras["mask"].mean() * (1 + jitter)
        return LossPack(error + 0.1 * size, {"l1": error, "size": size})

    def finish(self, model, scene):
        keep = torch.sigmoid(model.mask_logits) > 0.5
        inner = copy.deepcopy(model.inner)
        SplatOptimizer(inner, []).keep_rows(inner, keep)
        return inner


@pytest.fixture
def teacher(toy):
    return toy.make_model(toy.scene).requires_grad_(False).eval()


@pytest.fixture
def make(toy, teacher):
    def make(**options):
        stages = [
            toy.Stage(OptimizationParams(iterations=60)),
            MaskStage(OptimizationParams(iterations=40)),
            toy.Stage(OptimizationParams(iterations=30)),
        ]
        return toy.train(stages, trained=lambda name: teacher, **options)

    return make


def test_stages_follow_each_other_and_are_told_apart(make):
    outcome = make()
    assert list(outcome.figures.stage_seconds) == ["toy", "mask", "toy-2"]
    assert outcome.figures.steps == 130
    assert outcome.figures.train_s == pytest.approx(sum(outcome.figures.stage_seconds.values()))
    assert [(p.stage, p.iterations) for p in outcome.plan] == [("toy", 60), ("mask", 40), ("toy-2", 30)]
    assert outcome.plan[0].tasks[0] == {"stage": "Pre", "task": "update lr", "plan": "range(200)", "priority": 0}
    assert outcome.plan[1].tasks == []


def test_resuming_in_any_stage_equals_one_go(make, tmp_path):
    expected = make()
    for stop in (59, 60, 61, 100):
        with pytest.raises(TrainingStopped):
            make(directory=tmp_path / str(stop), stop_after=stop)
        resumed = make(directory=tmp_path / str(stop))
        assert resumed.model.digest() == expected.model.digest(), stop
        assert resumed.figures.steps == 130
        assert resumed.plan == expected.plan
        assert list(resumed.figures.stage_seconds) == list(expected.figures.stage_seconds)


def test_a_finished_run_of_several_stages_is_only_loaded(make, tmp_path):
    first = make(directory=tmp_path)
    steps = []
    again = make(directory=tmp_path, on_step=lambda _, r: steps.append(r.step))
    assert steps == []
    assert again.model.digest() == first.model.digest()


def test_a_later_stage_does_not_repeat_the_draws_of_the_first(toy):
    views = []
    stages = [toy.Stage(OptimizationParams(iterations=12)) for _ in range(2)]
    toy.train(stages, on_step=lambda _, r: views.append(r.view))
    assert views[:12] != views[12:]


def test_a_stage_that_starts_from_a_trained_scene_gets_a_copy_of_it(toy, teacher):
    asked = []

    class FromTrained(toy.Stage):
        starts_from = "3dgs"

        def begin(self, context):
            asked.append([p.requires_grad for p in context.model.parameters()])
            assert context.model.training
            return super().begin(context)

    def trained(name):
        asked.append(name)
        return teacher

    before = teacher.digest()
    outcome = toy.train(
        [FromTrained(OptimizationParams(iterations=30))],
        trained=trained,
        model=lambda: pytest.fail("a model is made although a trained one is asked for"),
    )
    assert asked == ["3dgs", [True] * 6]
    assert outcome.model.digest() != before
    assert teacher.digest() == before
    assert not any(p.requires_grad for p in teacher.parameters())


def test_a_borrowed_stage_brings_its_own_options(toy):
    class Options(OptimizationParams):
        strength: float = 0.5

    seen = []

    def task(opt: Options):
        seen.append(opt.strength)

    class Borrowed(toy.Stage):
        def register_pre_task(self, scheduler, ppl, opt):
            assert opt is self.opt
            scheduler.register_task(1, task)

    toy.train([toy.Stage(OptimizationParams(iterations=2)), Borrowed(Options(iterations=2, strength=0.7))])
    assert seen == [0.7]


def test_a_training_needs_a_stage(toy):
    with pytest.raises(ValueError, match="at least one stage"):
        toy.train([])


class Louder(WrappedStage):
    """The stage inside with twice its loss."""

    def loss(self, *arguments):
        pack = super().loss(*arguments)
        return LossPack(2 * pack.total, pack.parts)


def test_a_wrapped_stage_trains_as_the_stage_inside_but_for_what_it_overrides(toy):
    opt = OptimizationParams(iterations=40)
    plain, losses = toy.train([toy.Stage(opt)]), {}
    wrapped = toy.train([WrappedStage(toy.Stage(opt))], on_step=lambda _, r: losses.setdefault(r.step, float(r.total)))
    assert wrapped.model.digest() == plain.model.digest()
    louder = {}
    toy.train([Louder(toy.Stage(opt))], on_step=lambda _, r: louder.setdefault(r.step, float(r.total)))
    assert louder[1] == pytest.approx(2 * losses[1])


def test_every_member_of_a_stage_is_that_of_the_stage_inside(toy):
    class Inner(toy.Stage):
        iterations, starts_from, taught_by, prefer = 7, "base", ("teacher",), ("quick",)

    stage = WrappedStage(Inner(OptimizationParams(iterations=9)))
    for member in ("name", "opt", "iterations", "starts_from", "taught_by", "prefer"):
        assert getattr(stage, member) == getattr(stage.inner, member)
    own = {"name", "when", "whole_step"}  # steps are made of what the outer one overrides
    forwarded = {name for name in vars(Stage) if not name.startswith("_")} - own
    assert forwarded <= set(vars(WrappedStage))
    plans = [[r.name for s in build_schedulers(each, PipelineParams()) for r in s.registrations]
             for each in (stage, stage.inner)]  # fmt: skip
    assert plans[0] == plans[1]


def test_a_plan_is_scaled_by_the_stage():
    stage = Stage(OptimizationParams(iterations=3000, scale_schedule=True))
    assert stage.when(range(500, 15_000, 100)) == range(50, 1500, 10)
    assert Stage(OptimizationParams(iterations=3000)).when(7) == 7
