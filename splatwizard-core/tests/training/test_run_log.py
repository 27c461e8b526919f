"""log.jsonl: appended, and taken back as far as a resumed run repeats."""

import json

from splatwizard_core.base.run_log import RunLog


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_lines_are_appended_and_in_the_file_at_once(tmp_path):
    path = tmp_path / "deep" / "log.jsonl"
    RunLog(path).write(0, 10, loss=0.5, parts={"l1": 0.25})
    assert lines(path) == [{"stage": 0, "step": 10, "loss": 0.5, "parts": {"l1": 0.25}}]
    RunLog(path).write(1, 1, loss=0.4)
    assert [(x["stage"], x["step"]) for x in lines(path)] == [(0, 10), (1, 1)]


def test_rewinding_drops_what_comes_later_and_what_was_cut_off(tmp_path):
    path = tmp_path / "log.jsonl"
    for stage, step in ((0, 10), (0, 20), (1, 10), (1, 20), (1, 30)):
        RunLog(path).write(stage, step, loss=0.1)
    with path.open("a") as file:
        file.write('{"stage": 0, "st')
    RunLog(path).rewind(1, 20)
    assert [(x["stage"], x["step"]) for x in lines(path)] == [(0, 10), (0, 20), (1, 10), (1, 20)]
    RunLog(path).rewind(0, 15)
    assert [(x["stage"], x["step"]) for x in lines(path)] == [(0, 10)]


def test_numbers_that_are_not_finite_stay_json(tmp_path):
    path = tmp_path / "log.jsonl"
    RunLog(path).write(0, 1, loss=float("nan"), parts={"l1": float("inf")}, list=[1.0, float("-inf")])
    assert lines(path) == [{"stage": 0, "step": 1, "loss": None, "parts": {"l1": None}, "list": [1.0, None]}]


def test_without_a_path_nothing_is_kept(tmp_path):
    log = RunLog(None)
    log.rewind(0, 1)
    log.clear()
    log.write(0, 1, loss=1.0)
    assert list(tmp_path.iterdir()) == []
