"""The forms of a plan: which steps they mean, how they are scaled and printed."""

import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatwizard_core.training.params import OptimizationParams
from splatwizard_core.training.plan import (
    check_when,
    describe_when,
    plan_lines,
    plan_rows,
    scaled,
)
from splatwizard_core.training.scheduler import Scheduler, format_plan

steps = st.integers(0, 60)
ranges = st.builds(range, steps, st.integers(-5, 60), st.integers(1, 9))
listed = st.one_of(st.lists(steps), st.lists(steps).map(tuple), st.frozensets(steps), st.sets(steps))
plans = st.one_of(steps, ranges, listed)


def naive(when):
    """The steps of a plan, spelt out."""
    return {when} if isinstance(when, int) else set(when)


def registration(when, *, after=0):
    scheduler = Scheduler("pre")
    scheduler.register_task(when, noop)
    return replace(scheduler.registrations[0], after=after)


def noop():
    pass


@given(plans)
def test_membership_is_that_of_the_naive_set(when):
    found = registration(when).steps
    assert {s for s in range(-1, 70) if s in found} == naive(when)


@given(plans, st.integers(0, 70), st.integers(0, 70), st.integers(0, 70))
def test_executions_inside_a_window_are_those_of_the_naive_set(when, start, total, after):
    fires = registration(when, after=after).fires_in(start, total)
    expected = sorted(s for s in naive(when) if max(start, after, 0) < s <= total)
    assert list(fires) == expected
    unbounded = registration(when, after=after).fires_in(start, None)
    assert list(unbounded) == sorted(s for s in naive(when) if s > max(start, after))


@given(ranges)
def test_a_printed_range_evaluates_to_the_same_range(when):
    text = describe_when(when)
    again = eval(text, {"range": range, "__builtins__": {}})
    assert again == when
    assert (again.start, again.stop, again.step) == (when.start, when.stop, when.step)


@given(ranges)
def test_a_range_is_printed_with_the_fewest_arguments(when):
    arguments = 1 if when.start == 0 and when.step == 1 else 2 if when.step == 1 else 3
    assert describe_when(when).count(",") == arguments - 1


@pytest.mark.parametrize(
    ("when", "text"),
    [
        (range(30_000), "range(30000)"),
        (range(0, 15_000), "range(15000)"),
        (range(0, 30_000, 1000), "range(0, 30000, 1000)"),
        (range(500, 15_000, 100), "range(500, 15000, 100)"),
        (range(3, 9), "range(3, 9)"),
        (500, "500"),
        ([1, 5001], "[1, 5001]"),
        ((3, 1, 3), "[3, 1]"),
        ({9, 2}, "[2, 9]"),
        ([1, 2, 3, 4, 5, 6], "[1, 2, 3, 4, 5, 6]"),
        ([1, 2, 3, 4, 5, 6, 7], "[1, 2, 3, 4, 5, 6, ...]"),
        ([], "[]"),
    ],
)
def test_printed_form(when, text):
    assert describe_when(check_when(when)) == text


@pytest.mark.parametrize("when", [True, False, 1.0, "5", None, [1, True], [1, 2.0], iter([1, 2]), (s for s in [1])])
def test_what_is_no_plan_is_a_type_error(when):
    with pytest.raises(TypeError, match="a plan is an int, a range"):
        check_when(when)


def test_an_endless_iterator_is_not_consumed():
    import itertools

    with pytest.raises(TypeError):
        check_when(itertools.count(1))


@pytest.mark.parametrize("when", [-1, [3, -2], range(-5, 10), range(10, 0, -1), {-1}])
def test_negative_steps_are_a_value_error(when):
    with pytest.raises(ValueError):
        check_when(when)


@given(plans, st.floats(0.001, 3.0))
def test_scaling_keeps_the_form_and_what_can_fire(when, factor):
    when = check_when(when)
    result = scaled(when, factor)
    assert type(result) is type(when)
    if isinstance(when, range):
        assert result.step >= 1
        assert bool(result) == bool(when)
    else:
        assert any(s > 0 for s in naive(result)) == any(s > 0 for s in naive(when))


def test_scaling_multiplies_bounds_and_intervals():
    assert scaled(range(500, 15_000, 100), 0.1) == range(50, 1500, 10)
    assert scaled(range(0, 30_000, 1000), 7 / 30) == range(0, 7000, 233)
    assert scaled(range(500, 15_000, 100), 0.001) == range(1, 15, 1)
    assert scaled(500, 0.5) == 250
    assert scaled([1, 1000, 1001], 0.1) == [1, 100]
    assert scaled(range(30_000), 1.0) == range(30_000)


def make_plan():
    pre, post = Scheduler("pre"), Scheduler("post")
    pre.register_task(range(30_000), lambda: None, name="update lr")
    pre.register_task(range(0, 30_000, 1000), lambda: None, name="increase SH degree")
    post.register_task(range(15_000), lambda: None, name="collect gradient statistics")
    post.register_task(range(500, 15_000, 100), lambda: None, name="prune and densify")
    post.register_task(range(0, 15_000, 3000), lambda: None, name="reset opacity")
    return pre, post


def cells(text):
    return [[c.strip() for c in line.split("|")] for line in text.splitlines() if not set(line) <= set("-+")]


def test_the_3dgs_plan_prints_as_the_published_table():
    assert cells(format_plan(*make_plan())) == [
        ["Stage", "Task", "Plan"],
        ["Pre", "update lr", "range(30000)"],
        ["Pre", "increase SH degree", "range(0, 30000, 1000)"],
        ["Post", "collect gradient statistics", "range(15000)"],
        ["Post", "prune and densify", "range(500, 15000, 100)"],
        ["Post", "reset opacity", "range(0, 15000, 3000)"],
    ]


def test_verbose_adds_first_last_and_count_inside_the_run():
    pre, post = make_plan()
    rows = {row["task"]: row for row in plan_rows(pre.registrations, post.registrations, total=7000, verbose=True)}
    densify = rows["prune and densify"]
    assert (densify["first"], densify["last"], densify["count"]) == (500, 7000, 66)
    assert (rows["reset opacity"]["first"], rows["reset opacity"]["last"]) == (3000, 6000)
    table = cells(format_plan(pre, post, total=7000, verbose=True))
    assert table[0] == ["Stage", "Task", "Plan", "First", "Last", "Runs"]
    assert table[4][3:] == ["500", "7000", "66"]


def test_a_task_past_the_end_never_fires():
    pre = Scheduler("pre")
    pre.register_task(20_000, noop)
    (row,) = plan_rows(pre.registrations, [], total=7000, verbose=True)
    assert (row["first"], row["last"], row["count"]) == (None, None, 0)
    assert cells(format_plan(pre, Scheduler("post"), total=7000, verbose=True))[1][3:] == ["-", "-", "0"]


def test_json_has_one_object_a_registration():
    pre, post = make_plan()
    found = plan_rows(pre.registrations, post.registrations, total=30_000, verbose=True)
    rows = json.loads(json.dumps(found))
    assert [r["stage"] for r in rows] == ["Pre", "Pre", "Post", "Post", "Post"]
    assert rows[1] == {
        "stage": "Pre", "task": "increase SH degree", "plan": "range(0, 30000, 1000)", "priority": 0,
        "first": 1000, "last": 29_000, "count": 29,
    }  # fmt: skip


def test_rows_stand_in_order_of_execution():
    pre = Scheduler("pre")
    pre.register_task(1, noop, name="second")
    pre.register_task(1, noop, name="third", priority=5)
    pre.register_task(1, noop, name="first", priority=-1)
    assert [r["task"] for r in plan_rows(pre.registrations, [])] == ["first", "second", "third"]


def test_the_same_callable_twice_at_one_step_is_marked():
    post = Scheduler("post")
    post.register_task(range(0, 100, 10), noop, name="adjust anchor")
    post.register_task(range(50, 200, 25), noop, name="adjust anchor")
    post.register_task(range(0, 100, 10), lambda: None, name="another")
    assert ["overlaps" in r for r in plan_rows([], post.registrations)] == [True, True, False]
    assert "range(0, 100, 10) (overlaps)" in format_plan(Scheduler("pre"), post)


def test_the_same_callable_at_other_steps_is_no_overlap():
    post = Scheduler("post")
    post.register_task(range(0, 100, 10), noop)
    post.register_task(range(105, 200, 10), noop)
    post.register_task(range(100, 101), noop)
    assert not any("overlaps" in r for r in plan_rows([], post.registrations))
    # Step 0 stands in two plans and fires in neither.
    late = Scheduler("post")
    late.register_task(range(0, 100, 10), noop)
    late.register_task(0, noop)
    assert not any("overlaps" in r for r in plan_rows([], late.registrations))


def test_bound_methods_of_one_object_are_the_same_callable():
    class Model:
        def adjust(self):
            pass

    model, post = Model(), Scheduler("post")
    post.register_task(range(10), model.adjust)
    post.register_task(5, model.adjust)
    post.register_task(5, Model().adjust)
    assert ["overlaps" in r for r in plan_rows([], post.registrations)] == [True, True, False]


def test_what_identifies_a_plan_has_names_steps_and_priorities():
    def identity(when, name="a", priority=0):
        s = Scheduler("pre")
        s.register_task(when, noop, name=name, priority=priority)
        return plan_lines(s.registrations)

    base = identity([1, 2, 3, 4, 5, 6, 7])
    assert identity([7, 6, 5, 4, 3, 2, 1]) == base
    # The printed form of these is the same.
    assert identity([1, 2, 3, 4, 5, 6, 8]) != base
    assert identity([1, 2, 3, 4, 5, 6, 7], name="b") != base
    assert identity([1, 2, 3, 4, 5, 6, 7], priority=1) != base


def test_a_schedule_is_scaled_only_when_asked():
    assert OptimizationParams(iterations=3000).schedule_scale == 1.0
    assert OptimizationParams(iterations=3000, scale_schedule=True).schedule_scale == pytest.approx(0.1)
