"""When a run warns of a collapsed training: one line, or none."""

from typing import Any

from sw_report import after_run
from sw_report.after_run import report_finished
from sw_report.collapse import collapse_warning

from splatwizard_core.runs.observers import FinishedRun, FinishedRuns
from splatwizard_core.runs.record import MetricBlock, Record, TrainingPsnrBlock


def recorded(training: dict[str, Any] | None, test: float | None = 30.0) -> Record:
    sound = {"mean": 30.0, "median": 30.0, "quantile_05": 25.0, "far_below": {}}
    block = None if training is None else TrainingPsnrBlock.model_validate({**sound, **training})
    psnr = MetricBlock(mean=test, per_view=[], direction="higher")
    # The rest of a record plays no part.
    return Record.model_construct(method="toy", rate="r1", train_views=60, metrics={"psnr": psnr}, training_psnr=block)


def warning(training: dict[str, Any] | None, test: float | None = 30.0) -> str | None:
    return collapse_warning(recorded(training, test))


def test_a_sound_training_is_not_warned_of():
    assert warning({}) is None
    assert warning({"mean": 33.0}) is None  # 3 dB and no more
    assert warning(None) is None
    assert warning({"mean": None}, 10.0) is None
    assert warning({"mean": 40.0}, None) is None


def test_single_views_are_named_with_their_figures_and_what_to_look_at():
    line = warning({"far_below": {"b.png": 12.04, "e.png": 21.9}})
    assert line is not None
    assert "\n" not in line
    assert "toy r1: 2 of 60 training views lie far below their median of 30.0 dB" in line
    assert "(b.png 12.0, e.png 21.9)" in line
    assert "sw render --views train" in line


def test_many_views_are_counted():
    line = warning({"far_below": {f"{i}.png": float(i) for i in range(9)}})
    assert "9 of 60" in (line or "")
    assert "2.png 2.0 and 6 more)" in (line or "")


def test_test_views_far_below_training_views_are_told_with_both_means():
    line = warning({"mean": 33.2}, 30.1)
    assert line is not None
    assert "test views have 30.1 dB in the mean, training views 33.2" in line


def test_both_stand_in_one_line():
    line = warning({"mean": 36.0, "far_below": {"a.png": 3.0}})
    assert line is not None
    assert line.count("warning") == 1
    assert "a.png 3.0" in line
    assert "36.0" in line
    assert "\n" not in line


def test_a_run_that_finishes_is_told_of_and_at_the_end_no_more(tmp_path, monkeypatch):
    monkeypatch.setattr(after_run, "report_run", lambda *_: None)
    monkeypatch.setattr(after_run, "print_results", lambda *_: None)
    said: list[str] = []
    run = FinishedRun(tmp_path, recorded({"mean": 36.0}), None)
    for complete in (False, True):
        report_finished(FinishedRuns([run], complete, None, said.append))
    assert len(said) == 1
    assert said[0].startswith("warning: toy r1: test views have 30.0 dB in the mean, training views 36.0")
