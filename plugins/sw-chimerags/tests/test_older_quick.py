"""Runs by the quick plan of 2,500 steps, whose files name the preset of the student alone, go on with its values."""

from splatwizard_core.runs.config import resolve
from splatwizard_core.runs.pretrained import make_method
from sw_chimerags.method import ChimeraGS


def test_the_student_of_an_older_quick_run_has_the_values_of_then(plugins):
    older = {"iterations": 2_500, "train.stop": 1_900}
    for sets, student, beta2, start in ((older, (500, 500), 0.999, 200), ({}, (300, 300), 0.98, 120)):
        (made,) = make_method(plugins, resolve(ChimeraGS, "quick", sets=sets, scene="demo")).borrows()
        (base,) = made.borrows()
        assert (made.config.prune.start, made.config.prune.interval) == student
        assert (base.config.lr.beta2, base.config.density.settings["start"]) == (beta2, start)
