"""Where the resume check interrupts a training: around the firings of its tasks, the method's own first."""

from __future__ import annotations

import importlib

from sw_kit.checks.interruptions import stops_of

from splatwizard_core.api import OptimizationParams, Stage
from splatwizard_core.tooling import Entry


def planned_stage(**plans):
    """A stage of 40 steps with post tasks, name -> when; all but `foreign` are the stage's own."""

    class Planned(Stage):
        iterations = 40

        def register_post_task(self, scheduler, ppl, opt):
            for name, when in plans.items():
                scheduler.register_task(when, importlib.invalidate_caches if name == "foreign" else self.own, name=name)

        def own(self):
            pass

    return Planned(OptimizationParams())


def test_a_training_is_interrupted_where_its_tasks_could_lose_state():
    entry = Entry("method", "bad-thing", f"{__name__}:Method", "one line")
    planned = planned_stage(foreign=range(1, 41), own=[4, 8, 12])
    assert stops_of([planned], None, entry)[:3] == [3, 6, 20]
    # The same plan in a second stage, and a task that fires in the last step alone.
    assert set(stops_of([planned, planned_stage(own=40)], None, entry)) >= {3, 6, 40, 79}
    assert stops_of([planned_stage(own=range(1, 9))], None, entry) == [4, 20]
    assert stops_of([Stage(OptimizationParams(iterations=1))], None, entry) == []
