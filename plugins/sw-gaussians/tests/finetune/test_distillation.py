"""Pseudo views move the camera and nothing else; a student learns from its teacher, and resumes to the same bits."""

import copy
import json

import pytest
import torch
from sw_gaussians.finetune.distillation import DistillationStage, PseudoViewSampler, distillation_loss
from sw_gaussians.finetune.fine_tuning import FineTuningRates, FineTuningStage

from splatwizard_core.scene.scene import View
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.pipeline import TrainingStopped

RATES = FineTuningRates(position_init=1e-3, position_final=1e-3, opacity=0)


def sampler(views, **options):
    return PseudoViewSampler(views, torch.Generator().manual_seed(3), **{"std": 0.05, **options})


def test_two_steps_of_three_are_moved_by_std_and_the_training_views_stay(toy):
    before = [(v.camera, v.camera.R.clone(), v.camera.tau.clone()) for v in toy.scene.train]
    views = sampler(toy.scene.train)
    by_name = {v.name: v for v in toy.scene.train}
    shifts = []
    for step in range(1, 30_001):
        view = views.next(step)
        if step % 3 == 0:
            assert any(view is v for v in toy.scene.train)
            continue
        original = by_name[view.name.removesuffix(" (moved)")].camera
        assert view.load is None
        assert torch.equal(view.camera.R, original.R)
        assert (view.camera.fx, view.camera.cy, view.camera.width) == (original.fx, original.cy, original.width)
        shifts.append(view.camera.center - original.center)
    shifts = torch.stack(shifts)
    assert len(shifts) == 20_000
    assert shifts.std(dim=0).tolist() == pytest.approx([0.05] * 3, rel=0.02)
    assert shifts.mean(dim=0).abs().max() < 2e-3
    for view, (camera, R, tau) in zip(toy.scene.train, before, strict=True):
        assert view.camera is camera
        assert torch.equal(camera.R, R)
        assert torch.equal(camera.tau, tau)


def test_no_standard_deviation_is_the_training_pose_bit_for_bit(toy):
    views, plain = sampler(toy.scene.train, std=0.0), {v.name: v.camera for v in toy.scene.train}
    for step in (1, 2, 4, 5):
        view = views.next(step)
        assert torch.equal(view.camera.tau, plain[view.name.removesuffix(" (moved)")].tau)


def test_every_is_how_many_steps_share_one_training_view(toy):
    views = sampler(toy.scene.train, every=1)
    assert all("moved" not in views.next(step).name for step in range(1, 20))
    views = sampler(toy.scene.train, every=4)
    assert ["moved" in views.next(step).name for step in range(1, 9)] == [True, True, True, False] * 2
    with pytest.raises(ValueError, match="every"):
        sampler(toy.scene.train, every=0)


def test_a_sampler_goes_on_from_its_state(toy):
    first, second = sampler(toy.scene.train), sampler(toy.scene.train)
    for step in range(1, 8):
        first.next(step)
    state = first.state_dict()
    json.dumps(state["order"])
    second.load_state_dict(copy.deepcopy(state))
    for step in range(8, 20):
        a, b = first.next(step), second.next(step)
        assert a.name == b.name
        assert torch.equal(a.camera.tau, b.camera.tau)


def test_both_losses():
    image, target = torch.rand(3, 9, 9), torch.rand(3, 9, 9)
    assert distillation_loss(image, target, "l2").total == pytest.approx(float(((image - target) ** 2).mean()))
    pack = distillation_loss(image, target, lambda_dssim=0.2)
    assert float(pack.total) == pytest.approx(0.8 * float(pack.parts["l1"]) + 0.2 * (1 - float(pack.parts["ssim"])))
    assert float(distillation_loss(image, image).total) == pytest.approx(0, abs=1e-6)


class Before(FineTuningStage):
    name = "before"
    starts_from = "3dgs"


class Taught(DistillationStage):
    taught_by = ("3dgs",)


def stages(**options):
    opt = OptimizationParams(iterations=20)
    return [Before(opt, RATES), Taught(opt, RATES, **options)]


@pytest.fixture
def teacher(toy):
    model = toy.make_model(toy.scene)
    model.active_sh_degree = 1
    model.sh_rest.data += 0.3 * torch.randn(model.sh_rest.shape, generator=torch.Generator().manual_seed(1))
    return model.eval().requires_grad_(False)


def test_a_student_that_is_its_teacher_stays_it(toy, teacher):
    stage = Taught(OptimizationParams(iterations=10), RATES)
    losses = []
    toy.train([stage], model=lambda: copy.deepcopy(teacher).requires_grad_(True), trained=lambda name: teacher,
              on_step=lambda _, record: losses.append(float(record.total)))  # fmt: skip
    assert losses[0] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("kind", ["l1_ssim", "l2"])
def test_a_student_comes_nearer_to_its_teacher_and_leaves_it_alone(toy, teacher, kind):
    digest, asked = teacher.digest(), []

    def trained(name):
        asked.append(name)
        return teacher

    student = copy.deepcopy(teacher).requires_grad_(True)
    student.sh_rest.data.zero_()
    rates = FineTuningRates(sh_rest=0.01, opacity=0)
    losses = []
    outcome = toy.train(
        [Taught(OptimizationParams(iterations=60), rates, distill_loss=kind)],
        model=lambda: student, trained=trained, on_step=lambda _, record: losses.append(float(record.total)),
    )  # fmt: skip
    assert sum(losses[-6:]) < 0.7 * sum(losses[:6])
    assert asked == ["3dgs"]
    assert teacher.digest() == digest
    assert torch.equal(outcome.model.opacity_logits, teacher.opacity_logits)  # a rate of 0 is frozen
    assert not any("teacher" in name for name in outcome.model.state_dict())


def test_no_photograph_is_looked_at(toy, teacher, monkeypatch):
    blind = toy.make_scene()
    blind.train = [View(v.camera, v.name) for v in blind.train]
    monkeypatch.setattr("splatwizard_core.training.pipeline.decode_all", lambda views: None)
    toy.train(
        [Taught(OptimizationParams(iterations=6), RATES)],
        scene=blind, model=lambda: copy.deepcopy(teacher).requires_grad_(True), trained=lambda name: teacher,
    )  # fmt: skip


@pytest.mark.parametrize("stop", [13, 20, 21, 33])
def test_stopped_and_resumed_equals_one_go(toy, teacher, tmp_path, stop):
    whole = toy.train(stages(), trained=lambda name: teacher)
    ppl = PipelineParams(checkpoint_every=7)
    with pytest.raises(TrainingStopped):
        toy.train(stages(), trained=lambda name: teacher, directory=tmp_path, stop_after=stop, ppl=ppl)
    resumed = toy.train(stages(), trained=lambda name: teacher, directory=tmp_path, ppl=ppl)
    assert resumed.model.digest() == whole.model.digest()


class Selftaught(DistillationStage):
    """Taught by what the stage before left."""

    def find_teacher(self, context):
        return copy.deepcopy(context.model).requires_grad_(False)


def test_a_teacher_may_be_what_the_stage_before_left(toy, teacher, tmp_path):
    def both():
        opt = OptimizationParams(iterations=20)
        return [Before(opt, RATES), Selftaught(opt, RATES)]

    whole = toy.train(both(), trained=lambda name: teacher)
    with pytest.raises(TrainingStopped):
        toy.train(both(), trained=lambda name: teacher, directory=tmp_path, stop_after=30)
    resumed = toy.train(both(), trained=lambda name: teacher, directory=tmp_path)
    assert resumed.model.digest() == whole.model.digest()


def test_the_teacher_is_clamped_where_the_student_is(toy, teacher):
    bright = copy.deepcopy(teacher)
    bright.sh_dc += 5  # far above 1 nearly everywhere
    losses = {}
    for clamp in (False, True):
        toy.train(
            [Taught(OptimizationParams(iterations=2), RATES)],
            model=lambda: copy.deepcopy(bright).requires_grad_(True), trained=lambda name: bright,
            ppl=PipelineParams(clamp_render=clamp), on_step=lambda _, r, clamp=clamp: losses.setdefault(clamp, r.total),
        )  # fmt: skip
    assert float(losses[True]) == pytest.approx(0, abs=1e-6)
    assert float(losses[False]) == pytest.approx(0, abs=1e-6)
