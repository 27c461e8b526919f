"""When and in which order tasks run, and what they may do to the run."""

from types import SimpleNamespace

import pytest
from sw_anchors.phase_switch import PhaseSwitch

from splatwizard_core.errors import EmptyModel, TaskError, UserInputError
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.training.scheduler import STOP, Scheduler, task_name
from splatwizard_core.training.task_log import TaskLog


@pytest.fixture
def context():
    return SimpleNamespace(step=0, scheduler=None, result=None, loss=None, log=TaskLog(), model=SplatModel())


def recorder(log, name, result=None):
    def task(step: int):
        log.append((step, name))
        return result

    return task


def test_a_task_fires_at_its_steps_and_no_others(context):
    for when in (range(3, 12, 4), [7, 3, 11, 7], {3, 7, 11}, (11, 7, 3)):
        seen = []
        scheduler = Scheduler("pre")
        scheduler.register_task(when, recorder(seen, "it"))
        for step in range(1, 20):
            scheduler.exec(step, context)
        assert [s for s, _ in seen] == [3, 7, 11]


def test_step_zero_never_fires(context):
    seen = []
    scheduler = Scheduler("pre")
    scheduler.register_task(range(0, 30, 10), recorder(seen, "it"))
    scheduler.register_task(0, recorder(seen, "zero"))
    for step in range(0, 31):
        scheduler.exec(step, context)
    assert seen == [(10, "it"), (20, "it")]


def test_order_is_priority_then_registration(context):
    seen = []
    scheduler = Scheduler("post")
    for name, priority in (("c", 0), ("e", 10), ("a", -5), ("d", 0), ("f", 10), ("b", -5)):
        scheduler.register_task(5, recorder(seen, name), priority=priority)
    scheduler.exec(5, context)
    assert "".join(name for _, name in seen) == "abcdef"


def test_the_same_task_registered_twice_runs_twice(context):
    seen = []
    task = recorder(seen, "it")
    scheduler = Scheduler("post")
    scheduler.register_task(range(10), task)
    scheduler.register_task(5, task)
    for step in range(4, 7):
        scheduler.exec(step, context)
    assert [s for s, _ in seen] == [4, 5, 5, 6]


def test_past_the_last_plan_nothing_happens(context):
    seen = []
    scheduler = Scheduler("pre")
    scheduler.register_task(range(10), recorder(seen, "it", STOP))
    assert scheduler.exec(10, context) is False
    assert scheduler.exec(1_000_000, context) is False
    assert seen == []


def test_ranges_are_kept_as_given():
    scheduler = Scheduler("pre")
    when = range(10**12)
    scheduler.register_task(when, recorder([], "it"))
    assert scheduler.registrations[0].when is when


def test_a_bad_plan_is_refused_at_registration():
    with pytest.raises(TypeError):
        Scheduler("pre").register_task(2.5, lambda: None)
    with pytest.raises(ValueError):
        Scheduler("pre").register_task(-1, lambda: None)


def test_a_scheduler_is_for_pre_or_post():
    with pytest.raises(ValueError, match="'pre' or 'post'"):
        Scheduler("render")


@pytest.mark.parametrize("other", [None, 0, True, "STOP", object()])
def test_only_stop_stops(context, other):
    scheduler = Scheduler("pre")
    scheduler.register_task(1, recorder([], "it", other))
    assert scheduler.exec(1, context) is False


def test_stop_lets_the_other_tasks_of_the_step_run(context):
    seen = []
    scheduler = Scheduler("pre")
    scheduler.register_task(1, recorder(seen, "a", STOP))
    scheduler.register_task(1, recorder(seen, "b"))
    assert scheduler.exec(1, context) is True
    assert len(seen) == 2
    assert Scheduler.STOP is STOP


def test_what_a_task_raises_names_stage_step_and_task(context):
    def break_things():
        raise ZeroDivisionError("by zero")

    scheduler = Scheduler("post")
    scheduler.register_task(3, break_things)
    with pytest.raises(
        TaskError, match=r"'break things' \(post\) failed at step 3: ZeroDivisionError: by zero"
    ) as info:
        scheduler.exec(3, context)
    assert isinstance(info.value.__cause__, ZeroDivisionError)
    assert (info.value.stage, info.value.step, info.value.task) == ("post", 3, "break things")


def test_what_a_task_says_to_the_user_ends_as_wrong_input_does(context):
    def refuse():
        raise UserInputError("no file of 5 bytes")

    scheduler = Scheduler("post")
    scheduler.register_task(3, refuse)
    with pytest.raises(TaskError, match=r"at step 3: no file of 5 bytes") as info:
        scheduler.exec(3, context)
    assert info.value.exit_status == 2


def test_an_empty_model_is_reported_as_such(context):
    def prune(step: int):
        raise EmptyModel(step)

    scheduler = Scheduler("post")
    scheduler.register_task(3, prune)
    with pytest.raises(EmptyModel):
        scheduler.exec(3, context)


def test_a_task_may_register_tasks_for_later_steps(context):
    seen = []

    def grow(scheduler: Scheduler, step: int):
        scheduler.register_task(range(0, 10), recorder(seen, "late"), priority=-1)

    scheduler = Scheduler("pre")
    scheduler.register_task(4, grow)
    before = scheduler.plan_lines()
    assert not scheduler.pending_late(3)
    for step in range(1, 7):
        scheduler.exec(step, context)
    assert [s for s, _ in seen] == [5, 6]
    assert scheduler.pending_late(6)
    assert not scheduler.pending_late(9)
    assert scheduler.plan_lines() == before


def test_a_logging_task_leaves_a_line(context):
    scheduler = Scheduler("pre")
    scheduler.register_task(2, lambda: None, name="grow", log=True)
    scheduler.register_task(2, lambda: None, name="quiet")
    scheduler.exec(2, context)
    assert context.log.said == [("grow", "")]


class Grow:
    def __call__(self) -> None:
        pass


class GrowMore(Grow):
    pass


def test_tasks_of_a_class_can_be_given_another_priority():
    scheduler = Scheduler("post")
    for name, task in (("a", Grow()), ("b", lambda: None), ("c", GrowMore()), ("d", Grow())):
        scheduler.register_task(5, task, name=name)
    scheduler.reprioritise(Grow, 2)
    scheduler.register_task(5, lambda: None, name="between", priority=1)
    assert [(r.name, r.priority) for r in scheduler.registrations] == [
        ("b", 0), ("between", 1), ("a", 2), ("c", 2), ("d", 2),
    ]  # fmt: skip


class Counter:
    def __call__(self):
        pass


def update_learning_rate():
    pass


def test_default_names_read_like_words():
    import functools

    assert task_name(update_learning_rate) == "update learning rate"
    assert task_name(functools.partial(update_learning_rate)) == "update learning rate"
    assert task_name(Counter()) == "Counter"


class Phased(SplatModel):
    phase = "plain"

    def state_dict_extra(self):
        return {"phase": self.phase}


def test_a_phase_switch_sets_the_phase_and_shows_in_the_plan(context):
    scheduler = Scheduler("pre")
    PhaseSwitch(10, "entropy").register(scheduler)
    assert [(r.name, r.when) for r in scheduler.registrations] == [("switch to entropy", 10)]
    context.model = Phased()
    scheduler.exec(9, context)
    assert context.model.phase == "plain"
    scheduler.exec(10, context)
    assert context.model.phase == "entropy"


def test_a_phase_that_a_checkpoint_would_lose_is_an_error(context):
    scheduler = Scheduler("pre")
    PhaseSwitch(1, "entropy").register(scheduler)
    with pytest.raises(TaskError, match="must hold 'phase'"):
        scheduler.exec(1, context)


def test_a_phase_switch_may_run_a_task_of_its_own(context):
    seen = []
    scheduler = Scheduler("pre")
    PhaseSwitch(1, "entropy", recorder(seen, "own")).register(scheduler, priority=-3)
    scheduler.exec(1, context)
    assert seen == [(1, "own")]
    assert scheduler.registrations[0].priority == -3
