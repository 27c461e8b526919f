"""A run that is stopped, interrupted or killed and resumed ends in the same bits as one that is not."""

import json
import os
import random
import signal

import numpy as np
import pytest
import torch
from sw_gaussians.statistics import accumulate_statistics

from splatwizard_core.errors import CheckpointError, NothingToDo, SplatwizardError, TaskError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.rendering.rasterizer import RenderResult
from splatwizard_core.training.checkpoint import CheckpointStore
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.pipeline import TrainingStopped
from splatwizard_core.training.scheduler import STOP, Scheduler
from splatwizard_core.training.timing import LoopClock


@pytest.fixture(scope="module")
def trained_once():
    return {}


@pytest.fixture
def whole(toy, trained_once):
    """100 steps in one go."""
    outcome = trained_once.get("outcome") or trained_once.setdefault("outcome", toy.train(iterations=100))
    assert outcome.model.num_rows != 40  # densification did something,
    assert outcome.model.phase == "noisy"  # the mode changed,
    assert outcome.model.active_sh_degree == 1  # and so did the degree
    return outcome


def test_stopped_and_resumed_anywhere_equals_one_go(toy, whole, tmp_path):
    """Before, at and after densification, and before the last step."""
    for stop in (30, 44, 45, 99):
        with pytest.raises(TrainingStopped):
            toy.train(iterations=100, directory=tmp_path, stop_after=stop)
    resumed = toy.train(iterations=100, directory=tmp_path)
    assert resumed.model.digest() == whole.model.digest()
    assert resumed.figures.steps == 100


def test_a_second_run_equals_the_first_and_another_seed_does_not(toy, whole):
    torch.manual_seed(99)
    assert toy.train(iterations=100).model.digest() == whole.model.digest()
    one, other = (toy.train(iterations=5, ppl=PipelineParams(seed=seed)) for seed in (0, 1))
    assert one.model.digest() != other.model.digest()


def test_training_leaves_the_callers_generators_alone(toy):
    def draw():
        return random.random(), np.random.rand(), torch.rand(1).item()

    def seed():
        random.seed(1), np.random.seed(1), torch.manual_seed(1)

    seed()
    expected = draw()
    seed()
    toy.train(iterations=10)
    assert draw() == expected


def test_evaluation_changes_nothing(toy, whole, tmp_path):
    seen = []

    def evaluate(model, step):
        seen.append(step)
        assert not model.training
        assert not torch.is_grad_enabled()
        random.random(), np.random.rand(), torch.rand(5)
        return {"psnr": float(step)}

    ppl = PipelineParams(eval_every=25, checkpoint_every=15)
    outcome = toy.train(iterations=100, evaluate=evaluate, ppl=ppl, directory=tmp_path)
    assert seen == [25, 50, 75, 100]
    assert outcome.model.training
    assert outcome.model.digest() == whole.model.digest()
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [(x["step"], x["metrics"]["psnr"]) for x in lines if "metrics" in x] == [(s, float(s)) for s in seen]


def test_evaluation_keeps_the_mode_of_each_submodule(toy):
    def create():
        model = toy.make_model(toy.scene)
        model.teacher = torch.nn.Dropout().eval()
        return model

    outcome = toy.train(
        iterations=10, model=create, evaluate=lambda model, step: None, ppl=PipelineParams(eval_every=5)
    )
    assert outcome.model.training
    assert not outcome.model.teacher.training


def test_a_killed_run_goes_on_from_its_last_checkpoint(toy, whole, tmp_path):
    class Killed(BaseException):
        pass

    def kill(_, record):
        if record.step == 77:
            raise Killed

    ppl = PipelineParams(checkpoint_every=50)
    with pytest.raises(Killed):
        toy.train(iterations=100, directory=tmp_path, ppl=ppl, on_step=kill)
    steps = []
    resumed = toy.train(iterations=100, directory=tmp_path, ppl=ppl, on_step=lambda _, r: steps.append(r.step))
    assert steps == list(range(51, 101))
    assert resumed.model.digest() == whole.model.digest()


def test_the_log_of_a_resumed_run_has_each_step_once(toy, tmp_path):
    def fail(_, record):
        if record.step == 37:
            raise RuntimeError

    ppl = PipelineParams(checkpoint_every=20)
    with pytest.raises(RuntimeError):
        toy.train(iterations=50, directory=tmp_path / "a", ppl=ppl, on_step=fail)
    toy.train(iterations=50, directory=tmp_path / "a", ppl=ppl)
    toy.train(iterations=50, directory=tmp_path / "b", ppl=ppl)
    assert (tmp_path / "a" / "log.jsonl").read_text() == (tmp_path / "b" / "log.jsonl").read_text()


def test_ctrl_c_finishes_the_step_and_saves_it(toy, whole, tmp_path):
    class Interrupted(toy.Rasterizer):
        def render(self, g, cam, opt):
            if len(self.backgrounds) == 60:  # in the middle of step 61
                os.kill(os.getpid(), signal.SIGINT)
            return super().render(g, cam, opt)

    done = []
    steps = Interrupted()
    with pytest.raises(KeyboardInterrupt):
        toy.train(iterations=100, directory=tmp_path, rasterizer=steps, on_step=lambda _, r: done.append(r.step))
    assert done[-1] == 61
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    steps = []
    resumed = toy.train(iterations=100, directory=tmp_path, on_step=lambda _, r: steps.append(r.step))
    assert steps[0] == 62
    assert resumed.model.digest() == whole.model.digest()


def test_ctrl_c_between_steps_saves_too(toy, whole, tmp_path):
    def interrupt(_, record):
        if record.step == 77:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        toy.train(iterations=100, directory=tmp_path, on_step=interrupt)
    steps = []
    resumed = toy.train(iterations=100, directory=tmp_path, on_step=lambda _, r: steps.append(r.step))
    assert steps[0] == 78
    assert resumed.model.digest() == whole.model.digest()


@pytest.mark.parametrize("around", ["start", "stop"])
@pytest.mark.parametrize("step", [12, 20])
def test_ctrl_c_on_the_way_from_step_to_step_saves_too(toy, tmp_path, monkeypatch, around, step):
    """The clock starts when all that was due is done, and stops before it."""
    done, calls = [], []
    own = getattr(LoopClock, around)

    def interrupt(clock):
        own(clock)
        # The loop's own start comes before all steps.
        calls.append(around)
        if len(calls) == step + (around == "start"):
            os.kill(os.getpid(), signal.SIGINT)

    options = {"iterations": 20, "ppl": PipelineParams(log_every=1)}
    with monkeypatch.context() as patch:
        patch.setattr(LoopClock, around, interrupt)
        with pytest.raises(KeyboardInterrupt):
            toy.train(directory=tmp_path / "a", on_step=lambda _, r: done.append(r.step), **options)
    left = CheckpointStore(tmp_path / "a").restored(lambda found: found)
    assert left is not None
    assert left.step == done[-1] == min(20, step + (around == "start"))
    resumed = toy.train(directory=tmp_path / "a", **options)
    assert resumed.model.digest() == toy.train(directory=tmp_path / "b", **options).model.digest()
    assert (tmp_path / "a" / "log.jsonl").read_text() == (tmp_path / "b" / "log.jsonl").read_text()


def test_ctrl_c_after_the_last_step_leaves_a_finished_stage(toy, tmp_path):
    def interrupt(_, record):
        if record.step == 20:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        toy.train(iterations=20, directory=tmp_path, on_step=interrupt)
    steps = []
    resumed = toy.train(iterations=20, directory=tmp_path, on_step=lambda _, r: steps.append(r.step))
    assert steps == []
    assert resumed.model.digest() == toy.train(iterations=20).model.digest()


def test_a_second_ctrl_c_stops_at_once(toy, tmp_path):
    class Impatient(toy.Rasterizer):
        def render(self, g, cam, opt):
            if len(self.backgrounds) == 20:
                os.kill(os.getpid(), signal.SIGINT)
                os.kill(os.getpid(), signal.SIGINT)
            return super().render(g, cam, opt)

    done = []
    with pytest.raises(KeyboardInterrupt):
        toy.train(iterations=100, directory=tmp_path, rasterizer=Impatient(), on_step=lambda _, r: done.append(r.step))
    assert done[-1] == 20
    assert not list(tmp_path.glob("*.safetensors"))


def test_a_handler_of_someone_else_is_left_in_place(toy):
    def handler(number, frame):
        pass

    previous = signal.signal(signal.SIGINT, handler)
    try:
        toy.train(
            iterations=3, on_step=lambda _, r: pytest.fail("replaced") if signal.getsignal(2) is not handler else None
        )
    finally:
        signal.signal(signal.SIGINT, previous)


def test_training_works_outside_the_main_thread(toy):
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        outcome = pool.submit(toy.train, iterations=20).result()
    assert outcome.model.digest() == toy.train(iterations=20).model.digest()


def test_a_finished_run_is_only_loaded(toy, tmp_path):
    first = toy.train(iterations=30, directory=tmp_path)
    steps = []
    again = toy.train(iterations=30, directory=tmp_path, on_step=lambda _, r: steps.append(r.step))
    assert steps == []
    assert again.model.digest() == first.model.digest()
    assert again.figures == first.figures
    assert again.plan == first.plan
    with pytest.raises(TrainingStopped):
        # Stopping at the very end of the last stage is finishing; before, it is not.
        toy.train(iterations=30, directory=tmp_path / "b", stop_after=29)
    toy.train(iterations=30, directory=tmp_path / "b", stop_after=30)


def test_without_resuming_a_run_starts_again(toy, whole, tmp_path):
    with pytest.raises(TrainingStopped):
        toy.train(iterations=100, directory=tmp_path, stop_after=12)
    steps = []
    outcome = toy.train(iterations=100, directory=tmp_path, resume=False, on_step=lambda _, r: steps.append(r.step))
    assert steps[0] == 1
    assert outcome.model.digest() == whole.model.digest()
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert sum(line["step"] == 10 and "loss" in line for line in lines) == 1


def test_a_shorter_run_than_its_checkpoint_has_nothing_to_do(toy, tmp_path):
    with pytest.raises(TrainingStopped):
        toy.train(iterations=100, directory=tmp_path, stop_after=20)
    options = {"identity": {"method": "toy", "iterations": 20}, "allow_changed_plan": True}
    with pytest.raises(NothingToDo, match="ends at step 20, and 20 steps are done"):
        toy.train(iterations=20, directory=tmp_path, **options)


def test_a_stage_may_have_no_steps_and_is_finished_at_once(toy, tmp_path):
    """As that of a method which only encodes a trained scene."""

    class NoSteps(toy.Stage):
        iterations = 0

    outcome = toy.train([NoSteps(OptimizationParams())], directory=tmp_path)
    assert outcome.figures.steps == 0
    again = toy.train([NoSteps(OptimizationParams())], directory=tmp_path)
    assert again.model.digest() == outcome.model.digest() == toy.make_model(toy.scene).digest()


def test_a_finished_run_can_be_made_longer(toy, tmp_path):
    toy.train(iterations=20, directory=tmp_path, identity={"iterations": 20})
    steps = []
    longer = toy.train(
        iterations=30, directory=tmp_path, identity={"iterations": 30}, allow_changed_plan=True,
        on_step=lambda _, r: steps.append(r.step),
    )  # fmt: skip
    assert steps == list(range(21, 31))
    assert longer.figures.steps == 30


def test_another_configuration_is_refused_and_named(toy, tmp_path, caplog):
    with pytest.raises(TrainingStopped):
        toy.train(iterations=60, directory=tmp_path, stop_after=10, identity={"lr": {"means": 0.1}})
    with pytest.raises(CheckpointError, match=r"lr\.means: 0\.1 -> 0\.2.*--allow-changed-plan"):
        toy.train(iterations=60, directory=tmp_path, identity={"lr": {"means": 0.2}})
    with pytest.raises(TrainingStopped):
        toy.train(
            iterations=60, directory=tmp_path, stop_after=12, identity={"lr": {"means": 0.2}}, allow_changed_plan=True
        )
    assert "lr.means: 0.1 -> 0.2" in caplog.text


def test_another_plan_is_refused_and_shown(toy, tmp_path, caplog):
    class Other(toy.Stage):
        def register_pre_task(self, scheduler, ppl, opt):
            super().register_pre_task(scheduler, ppl, opt)
            scheduler.register_task(range(5, 50, 5), lambda: None, name="new idea")

    with pytest.raises(TrainingStopped):
        toy.train(iterations=60, directory=tmp_path, stop_after=8)
    other = [Other(OptimizationParams(iterations=60))]
    with pytest.raises(CheckpointError, match=r"plan \+ pre \| new idea \| range\(5, 50, 5\)"):
        toy.train(other, directory=tmp_path)
    assert toy.train(other, directory=tmp_path, allow_changed_plan=True).figures.steps == 60
    assert "plan + pre | new idea" in caplog.text


def test_another_scene_is_refused(toy, tmp_path):
    with pytest.raises(TrainingStopped):
        toy.train(iterations=60, directory=tmp_path, stop_after=8)
    wider = toy.make_scene(radius=4.0)
    with pytest.raises(CheckpointError, match="scene extent"):
        toy.train(iterations=60, directory=tmp_path, scene=wider)
    fewer = toy.make_scene(views=3)
    fewer.extent = toy.scene.extent
    with pytest.raises(CheckpointError, match=r"a sampler of other views: view 5 of 3"):
        toy.train(iterations=60, directory=tmp_path, scene=fewer)


def test_state_that_does_not_fit_the_model_is_a_checkpoint_error(toy, tmp_path):
    from splatwizard_core.gaussians.model import GaussianModel

    with pytest.raises(TrainingStopped):
        toy.train(iterations=60, directory=tmp_path, stop_after=8)

    class Renamed(GaussianModel):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            self.mlp = torch.nn.Linear(2, 2)

        def load_state_dict_extra(self, extra):
            pass

    with pytest.raises(CheckpointError, match="step 8, does not fit this run"):
        toy.train(iterations=60, directory=tmp_path, model=lambda: toy.make_model(toy.scene, Renamed))


def test_a_damaged_checkpoint_costs_only_the_steps_since_the_one_before(toy, whole, tmp_path, caplog):
    ppl = PipelineParams(checkpoint_every=20, keep_checkpoints=2)
    with pytest.raises(TrainingStopped):
        toy.train(iterations=100, directory=tmp_path, ppl=ppl, stop_after=60)
    newest = tmp_path / "00-0000060.safetensors"
    data = bytearray(newest.read_bytes())
    data[-5] ^= 1
    newest.write_bytes(data)
    steps = []
    resumed = toy.train(iterations=100, directory=tmp_path, ppl=ppl, on_step=lambda _, r: steps.append(r.step))
    assert steps[0] == 41
    assert resumed.model.digest() == whole.model.digest()
    assert "resuming from 00-0000040.json instead" in caplog.text


@pytest.mark.parametrize(
    "spoil",
    [
        lambda state: state["model"].popitem(),
        lambda state: state["model"].update(means=torch.zeros(3)),
        lambda state: state.pop("rng"),
        lambda state: state["optimizer"].update(moments=5),
        lambda state: state.update(sampler=None),
    ],
)
def test_a_state_that_cannot_be_restored_costs_only_the_steps_since_the_one_before(spoil, toy, tmp_path, caplog):
    """Sums that are right say nothing of what was summed."""
    ppl = PipelineParams(checkpoint_every=10, keep_checkpoints=2)
    with pytest.raises(TrainingStopped):
        toy.train(iterations=30, directory=tmp_path, ppl=ppl, stop_after=20)
    store = CheckpointStore(tmp_path, keep=2)
    saved = store.restored(lambda found: found)
    assert saved.step == 20
    spoil(saved.state)
    store.write(saved)
    steps = []
    toy.train(iterations=30, directory=tmp_path, ppl=ppl, on_step=lambda _, r: steps.append(r.step))
    assert steps[0] == 11
    assert "resuming from 00-0000010.json instead" in caplog.text


def test_a_model_of_nothing_but_nan_is_an_error_at_the_end(toy, tmp_path):
    with pytest.raises(TrainingStopped):
        toy.train(iterations=20, directory=tmp_path, stop_after=19)
    store = CheckpointStore(tmp_path)
    saved = store.restored(lambda found: found)
    saved.state["model"]["means"].fill_(torch.nan)
    saved.step, saved.finished = 20, True
    store.write(saved)
    with pytest.raises(SplatwizardError, match=r"all \d+ gaussians of the model hold values that are not finite"):
        toy.train(iterations=20, directory=tmp_path)


def test_stop_by_a_task_finishes_the_stage_for_good(toy, tmp_path):
    class Stopping(toy.Stage):
        def register_post_task(self, scheduler, ppl, opt):
            scheduler.register_task(33, lambda: STOP, name="enough")

    stages = [Stopping(OptimizationParams(iterations=100))]
    first = toy.train(stages, directory=tmp_path)
    assert first.figures.steps == 33
    steps = []
    again = toy.train(stages, directory=tmp_path, on_step=lambda _, r: steps.append(r.step))
    assert steps == []
    assert again.model.digest() == first.model.digest()


class LateStage:
    """Made into a stage below: at step 20 a task registers another for steps 30 and 40."""

    def register_pre_task(self, scheduler, ppl, opt):
        scheduler.register_task(20, register_later)

    def register_post_task(self, scheduler, ppl, opt):
        scheduler.register_task(range(200), collect)


def collect(model: GaussianModel, result: RenderResult):
    accumulate_statistics(model, result.grad2d.value, result.radii)


def register_later(scheduler: Scheduler):
    scheduler.register_task([10, 30, 40], fade)


def fade(model: GaussianModel):
    model.opacity_logits.sub_(0.5)


def test_late_tasks_survive_a_resume_because_no_checkpoint_is_written_before_they_ran(toy, tmp_path, caplog):
    stages = [type("Late", (LateStage, toy.Stage), {})(OptimizationParams(iterations=60))]
    expected = toy.train(stages)
    ppl = PipelineParams(checkpoint_every=5)
    with pytest.raises(TrainingStopped):
        toy.train(stages, directory=tmp_path, ppl=ppl, stop_after=35)
    assert "no checkpoint at step 35" in caplog.text
    assert [p.name for p in tmp_path.glob("*.json")] == ["00-0000015.json"]
    assert toy.train(stages, directory=tmp_path, ppl=ppl).model.digest() == expected.model.digest()


def test_a_run_without_a_directory_writes_nothing(toy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    toy.train(iterations=20, ppl=PipelineParams(checkpoint_every=5))
    assert list(tmp_path.iterdir()) == []


def test_times_and_steps_add_up_over_processes(toy, now, tmp_path):
    class TwoSeconds(toy.Rasterizer):
        def render(self, *given):
            now[0] += 2
            return super().render(*given)

    same = {
        "iterations": 60,
        "directory": tmp_path,
        "rasterizer": TwoSeconds(),
        "ppl": PipelineParams(profile="stages"),
    }
    with pytest.raises(TrainingStopped):
        toy.train(**same, stop_after=59)
    part = json.loads((tmp_path / "00-0000059.json").read_text())["content"]["progress"]
    now[0] = 0.0  # another process, another clock
    outcome = toy.train(**same)
    assert part["stage_steps"] == {"toy": 59}
    assert (part["stage_seconds"]["toy"], outcome.figures.train_s) == (118, 120)
    assert (part["breakdown_s"]["toy"]["render"], outcome.figures.breakdown_s["toy"]["render"]) == (118, 120)
    assert outcome.figures.steps == 60
    assert outcome.figures.peak_bytes >= part["peak_bytes"] >= 0


def test_a_failing_task_leaves_the_last_checkpoint(toy, tmp_path):
    class Failing(toy.Stage):
        def register_pre_task(self, scheduler, ppl, opt):
            scheduler.register_task(25, fail_once)

    def fail_once():
        raise OSError("gone")

    with pytest.raises(TaskError):
        toy.train(
            [Failing(OptimizationParams(iterations=60))], directory=tmp_path, ppl=PipelineParams(checkpoint_every=10)
        )
    assert [p.name for p in tmp_path.glob("*.json")] == ["00-0000020.json"]
