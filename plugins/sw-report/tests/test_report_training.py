"""log.jsonl as curves."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sw_report.method_styles import styles_of
from sw_report.numbers import SHARED_NOTE
from sw_report.plots import training_charts
from sw_report.runs import collect
from sw_report.training_log import log_path, read_training, thin


@given(st.integers(1, 2000), st.integers(4, 300))
def test_thinning_keeps_the_ends_the_order_and_the_number(n, points):
    values = [(float(i), float(i % 17)) for i in range(n)]
    found = thin(values, points)
    assert len(found) == min(n, points)
    assert (found[0], found[-1]) == (values[0], values[-1])
    steps = [x for x, _ in found]
    assert steps == sorted(set(steps))


def test_thinning_averages_what_it_joins():
    values = [(float(i), float(i)) for i in range(1002)]
    found = thin(values, 12)  # ten groups of a hundred between the ends
    assert found[1] == (100.0, pytest.approx(50.5))
    assert sum(y for _, y in found[1:-1]) / 10 == pytest.approx(sum(range(1, 1001)) / 1000)


def test_steps_count_on_over_stages_and_anchors_are_their_own_curve(tmp_path):
    lines = [{"stage": s, "step": n, "loss": 1.0, "num_anchors": 10 * n} for s in (0, 1) for n in (1, 50, 100)]
    lines.insert(2, {"stage": 0, "step": 60, "task": "prune"})
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    curves = read_training(tmp_path / "log.jsonl")
    assert [x for x, _ in curves.loss] == [1, 50, 100, 101, 150, 200]
    assert curves.stages == [(0, 0), (100, 1)]
    assert list(curves.counts) == ["num_anchors"]
    assert (curves.lines, curves.damaged, curves.missing) == (6, 0, None)


@pytest.mark.parametrize(
    "line",
    ['{"stage": 0, "step": 9', "[]", "", '{"stage": true, "step": 1}', '{"stage": 0, "step": -1}', '{"step": 1}',
     '{"stage": 0, "step": 1e400}', "[" * 100_000],
)  # fmt: skip
def test_a_damaged_line_is_counted_and_passed_over(tmp_path, line):
    good = '{"stage": 0, "step": 1, "loss": 0.5}\n'
    (tmp_path / "log.jsonl").write_text(good + line + "\n" + good)
    curves = read_training(tmp_path / "log.jsonl")
    assert (curves.lines, curves.damaged) == (2, 1)


@pytest.mark.parametrize("loss", ["NaN", "Infinity", "null", '"0.1"', "1e999", "true"])
def test_a_loss_that_is_no_number_is_no_point(tmp_path, loss):
    (tmp_path / "log.jsonl").write_text(f'{{"stage": 0, "step": 1, "loss": {loss}}}\n')
    assert read_training(tmp_path / "log.jsonl").missing == "log.jsonl holds no step"


def test_what_tasks_recorded_is_a_curve_each(tmp_path):
    lines = [
        {"stage": s, "step": n, "scalars": {"pruned": 10 * n, "<b>odd</b>": None if n == 5 else 1}}
        for s in (0, 1)
        for n in (5, 10)
    ]
    lines += [{"stage": 1, "step": 11, "scalars": other} for other in ([], {"pruned": "3"}, {"x": True}, "pruned")]
    lines.append({"stage": 1, "step": 12, "scalars": {f"curve {i}" * 20: i for i in range(40)}})
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    curves = read_training(tmp_path / "log.jsonl")
    assert curves.scalars["pruned"] == [(5, 50), (10, 100), (15, 50), (20, 100)]
    assert curves.scalars["<b>odd</b>"] == [(10, 1), (20, 1)]
    assert len(curves.scalars) == 12
    assert max(map(len, curves.scalars)) == 64
    assert (curves.damaged, curves.missing) == (0, None)


def test_the_page_draws_what_tasks_recorded(make_run):
    directory = make_run("r1", keep=("log",))
    with (directory / "log.jsonl").open("a") as file:
        for step in (301, 302):
            file.write(json.dumps({"stage": 0, "step": step, "scalars": {"dead <codes>": step}}) + "\n")
        file.write(json.dumps({"stage": 0, "step": 303, "scalars": {"only once": 1}}) + "\n")
    runs = collect([directory]).runs
    charts, missing = training_charts(runs, styles_of(runs))
    assert not missing
    assert [figure.caption for figure in charts.figures][2:] == ["dead <codes>"]
    assert "dead &lt;codes&gt; over steps" in str(charts.figures[2].svg)


def test_a_missing_log_is_said(tmp_path):
    assert read_training(tmp_path / "log.jsonl").missing == "no log.jsonl"


def test_a_shared_training_has_its_log_next_door(make_run, tmp_path):
    make_run("r1")
    shared = make_run("r2", size=5000, keep=("renders",), change=lambda c: c["train"].update(trained_in="r1"))
    run = collect([shared]).runs[0]
    assert log_path(run) == shared.parent / "r1" / "log.jsonl"
    assert len(read_training(log_path(run)).loss) == 60


@pytest.mark.parametrize("name", ["../../../etc", "/etc", "..", "a/b", ""])
def test_a_record_cannot_lead_to_other_folders(make_run, name):
    directory = make_run(keep=(), change=lambda c: c["train"].update(trained_in=name))
    found = log_path(collect([directory]).runs[0])
    assert found.parent in (directory, directory.parent / name)
    assert found.parent.parent in (directory.parent, directory.parent.parent)


def test_evaluations_are_curves_over_seconds_of_training(tmp_path):
    lines = [{"stage": 0, "step": n, "metrics": {"psnr": 20 + n}, "train_s": n / 2} for n in (1, 2, 3)]
    lines += [{"stage": 0, "step": 3, "loss": 1.0}, {"stage": 0, "step": 4, "metrics": {"psnr": 9}}]  # without seconds
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert read_training(tmp_path / "log.jsonl").quality == {"psnr": [(0.5, 21.0), (1.0, 22.0), (1.5, 23.0)]}


def test_the_page_draws_quality_over_seconds(make_run):
    directory = make_run("r1", keep=("log",))
    with (directory / "log.jsonl").open("a") as file:
        for step in (301, 302):
            line = {"stage": 0, "step": step, "metrics": {"ssim": 0.5, "psnr": step / 10}, "train_s": step / 100}
            file.write(json.dumps(line) + "\n")
    runs = collect([directory]).runs
    charts, _ = training_charts(runs, styles_of(runs))
    captions = [figure.caption for figure in charts.figures]
    assert captions[1] == "PSNR of the test views over seconds of training, evaluation not counted"
    assert captions[2].startswith("SSIM")
    assert "seconds of training" in str(charts.figures[1].svg)


def test_seconds_of_a_shared_machine_are_marked_below_the_curve(make_run):
    directory = make_run("r1", keep=("log",), change=lambda c: c.update(contended={"train": 0.5}))
    with (directory / "log.jsonl").open("a") as file:
        for step in (301, 302):
            line = {"stage": 0, "step": step, "metrics": {"psnr": step / 10}, "train_s": step / 100}
            file.write(json.dumps(line) + "\n")
    runs = collect([directory]).runs
    charts, _ = training_charts(runs, styles_of(runs))
    marked = [figure.caption for figure in charts.figures if SHARED_NOTE in figure.caption]
    assert len(marked) == 1
    assert marked[0].startswith("PSNR of the test views over seconds")
